"""`rgbd-calib intrinsics`: what it prints and writes, and what it leaves out."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from synthetic_views import BOARD, CORNER_NOISE, arc, make_recording, write_recording

from rgbd_calib.geometry import se3, so3
from rgbd_calib.io.correspondences import read_corners, write_corners
from rgbd_calib.io.files import load_yaml
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_intrinsics, read_intrinsics_sd
from rgbd_calib.pipeline.calibrate import calibrate
from rgbd_calib.pipeline.config import load_config
from rgbd_calib.pipeline.detection import Detections
from rgbd_calib.simulation.views import true_views


def close_recording(folder, square_on=False):
    """Each camera alone, the board close and tilted (or always square to it)."""
    rig, rng = arc(2), np.random.default_rng(0)
    boards, views, middle = {}, [], BOARD.corners_m().mean(axis=0)
    for name, own in rig.cameras.items():
        alone = replace(rig, reference=name, cameras={name: own})
        n = 0
        while n < 10:
            R = so3.exp(np.zeros(3) if square_on else rng.uniform(-0.6, 0.6, 3) * [1, 1, 0.3])
            at = np.array([rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.2), 1.0]) * rng.uniform(0.7, 1.1)
            frame = f"{len(boards):06d}"
            T = {frame: own.T_world_color @ se3.make(R, at - R @ middle)}
            if seen := true_views(alone, T, BOARD, CORNER_NOISE, rng):
                boards |= T
                views += seen
                n += 1
    return write_recording(folder, rig, BOARD, boards, views)


@pytest.fixture(scope="module")
def close(tmp_path_factory):
    return close_recording(tmp_path_factory.mktemp("close"))


def test_recovers_each_lens(run, close, tmp_path):
    path = tmp_path / "intrinsics.yaml"
    out = run("intrinsics", close.path, "--corners", close.corners, "-o", path)
    assert out.status == 0, out.stderr
    assert [line.split(":")[0] for line in out.stdout.splitlines()] == ["C1", "C2"]
    assert "px; RMS 0.1" in out.stdout
    assert f"Wrote {path}" in out.stderr
    lenses, sd = read_intrinsics(path), read_intrinsics_sd(path)
    for name, own in close.rig.cameras.items():
        assert np.all(np.abs(lenses[name].vector - own.intrinsics.vector) <= 5 * sd[name]), name
    entry = load_yaml(path)["cameras"]["C2"]
    assert entry["views"] == len(entry["view_rms_px"]) == 10
    assert load_yaml(path)["provenance"]["recording"] == str(close.path)


def test_names_the_view_that_it_leaves_out(run, close, tmp_path):
    views = list(close.views)
    shifted = views[4].corners_px.copy()
    shifted[::2] += [12.0, -7.0]
    views[4] = replace(views[4], corners_px=shifted)
    write_corners(tmp_path / "corners.csv", views)
    out = run("intrinsics", close.path, "--corners", tmp_path / "corners.csv", "-o", tmp_path / "i.yaml")
    assert out.status == 0, out.stderr
    assert f"{views[4].camera}: frame {views[4].frame} left out: RMS" in out.stderr
    assert list(load_yaml(tmp_path / "i.yaml")["cameras"]["C1"]["dropped"]) == [views[4].frame]


def test_same_bytes_again(run, close, tmp_path):
    path = tmp_path / "intrinsics.yaml"
    texts = []
    for _ in range(2):
        run("intrinsics", close.path, "--corners", close.corners, "-o", path, "--overwrite")
        texts.append(path.read_bytes())
    assert texts[0] == texts[1]


def test_square_on_views_are_refused(run, tmp_path):
    recording = close_recording(tmp_path, square_on=True)
    out = run("intrinsics", recording.path, "--corners", recording.corners, "-o", tmp_path / "i.yaml")
    assert out.status == 1
    assert out.stderr.startswith("Error: C1: ")
    assert "Film the board tilted up to 40 degrees" in out.stderr
    assert not (tmp_path / "i.yaml").exists()


def test_calibrate_takes_what_was_written(run, close, tmp_path):
    recording = make_recording(tmp_path, close.rig, frames=8)
    run("intrinsics", close.path, "--corners", close.corners, "-o", tmp_path / "i.yaml")
    args = ("calibrate", recording.path, "--corners", recording.corners, "-o", tmp_path / "rig.yaml")
    out = run(*args, "--intrinsics", tmp_path / "i.yaml")
    assert out.status == 0, out.stderr
    assert load_yaml(tmp_path / "rig.yaml")["provenance"]["intrinsics"] == str(tmp_path / "i.yaml")


def test_the_bundle_uses_the_close_views_too(close, tmp_path):
    recording = make_recording(tmp_path, close.rig, frames=8)
    corners = [Detections(read_corners(r.corners), ()) for r in (recording, close)]
    result = calibrate(
        open_recording(recording.path),
        load_config(None),
        intrinsics=close.path,
        detections=corners[0],
        intrinsic_detections=corners[1],
    )
    assert result.rig.provenance["intrinsics"] == str(close.path)
    assert any(" alone: " in frame for frame in result.residuals.frame)
    for name, own in close.rig.cameras.items():
        off_px = np.abs(result.rig.cameras[name].intrinsics.vector - own.intrinsics.vector)[:4]
        assert np.all(off_px < 5 * 0.001 * own.intrinsics.fx)  # 10 close views give 0.5 px of 540: 0.1 %


def test_results_as_json(run, close, tmp_path):
    out = run("intrinsics", close.path, "--corners", close.corners, "-o", tmp_path / "i.yaml", "--json")
    numbers = json.loads(out.stdout)
    for name, lens in read_intrinsics(tmp_path / "i.yaml").items():
        own = numbers["cameras"][name]
        assert own["intrinsics"]["fx"] == pytest.approx(lens.fx, abs=1e-3) and own["views"] == 10
        assert len(own["sd"]) == 9 and own["dropped"] == {}

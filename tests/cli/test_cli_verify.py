"""`rgbd-calib verify` and `calibrate --update`, `--world`, as a user runs them, on a drawn recording of three cameras."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from qualities import expected
from small_recording import FOCAL_PX, HEIGHT, WIDTH, camera_pose, draw_recording

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.correspondences import write_corners
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_boards, read_rig, write_intrinsics, write_rig
from rgbd_calib.pipeline.detection import detect
from rgbd_calib.pipeline.workers import Workers
from rgbd_calib.quality import CameraStatistics, Quality
from rgbd_calib.types import Rig, RigCamera
from rgbd_calib.views.detect import DetectParams

LENS = Intrinsics(WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
SD = np.diag([1e-4**2] * 3 + [2e-4**2] * 3)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Folder with a recording, its corners and the rig that drew it."""
    folder = tmp_path_factory.mktemp("drawn")
    recording = open_recording(draw_recording(folder / "recording", cameras=3, frames=7))
    write_corners(folder / "corners.csv", detect(recording, DetectParams(), Workers(2)).views)
    cameras = {
        f"C{i + 1}": RigCamera(
            LENS, camera_pose(i, 3), SD if i else np.zeros((6, 6)), None, CameraStatistics(sigma_2d_px=0.1)
        )
        for i in range(3)
    }
    write_rig(
        folder / "rig.yaml",
        Rig("C1", cameras, Quality(expected_alignment=expected(1.0), other={"views": 3}), {"seed": 0}),
    )
    write_intrinsics(folder / "intrinsics.yaml", dict.fromkeys(cameras, LENS), {}, {}, {})
    return folder


def arguments(drawn):
    return (drawn / "recording", "--corners", drawn / "corners.csv")


def displaced(drawn, path, name, shift_m):
    """A rig file in which one camera stands elsewhere than it did."""
    rig = read_rig(drawn / "rig.yaml")
    own = rig.cameras[name]
    T = own.T_world_color @ se3.make(np.eye(3), np.array([shift_m, 0.0, 0.0]))
    write_rig(path, replace(rig, cameras=rig.cameras | {name: replace(own, T_world_color=T)}))
    return path


def blocks(path):
    """The text of each camera's entry."""
    text = path.read_text()
    lines = text.splitlines(keepends=True)
    root = yaml.compose(text)
    ((cameras, last),) = [(v, k.start_mark.line) for k, v in root.value if k.value == "cameras"]
    after = [k.start_mark.line for k, _ in root.value if k.start_mark.line > last]
    starts = [k.start_mark.line for k, _ in cameras.value]
    ends = [*starts[1:], after[0]]
    return {k.value: "".join(lines[a:b]) for (k, _), a, b in zip(cameras.value, starts, ends, strict=True)}


def test_verify_passes_the_rig_that_drew_the_recording(run, drawn):
    out = run("verify", drawn / "rig.yaml", *arguments(drawn))
    assert out.status == 0 and "PASS" in out.stdout and "C1 - C3" in out.stdout


@pytest.mark.parametrize("name", ["C1", "C3"])
def test_verify_names_the_camera_that_moved(run, drawn, tmp_path, name):
    rig = displaced(drawn, tmp_path / "rig.yaml", name, 0.006)
    out = run("verify", rig, *arguments(drawn), "--json")
    numbers = json.loads(out.stdout)
    assert out.status == 1 and numbers["moved"] == [name] and not numbers["or_else"]
    # drawn without noise: 1 mm is many times what corner finding leaves
    assert numbers["cameras"][name]["shift_mm"] == pytest.approx(6, abs=1)
    text = run("verify", rig, *arguments(drawn))
    assert text.status == 1 and f"FAIL: {name} moved" in text.stdout and "--only" in text.stdout
    assert run("verify", rig, *arguments(drawn), "--max-mm", 10).status == 0


def test_verify_says_what_is_wrong_with_its_input(run, drawn, tmp_path):
    assert run("verify", tmp_path / "none.yaml", *arguments(drawn)).status == 2
    assert run("verify", drawn / "rig.yaml", *arguments(drawn), "--max-mm", 0).status == 2


def test_frames_that_the_rig_was_calibrated_from_prove_nothing(run, drawn, tmp_path):
    given = ("--intrinsics", drawn / "intrinsics.yaml")
    assert run("calibrate", *arguments(drawn), *given, "-o", tmp_path / "rig.yaml").status == 0
    same = run("verify", tmp_path / "rig.yaml", *arguments(drawn))
    assert same.status == 2 and "all 7 frames were used to calibrate this rig" in same.stderr
    # the same images under other names, beside new ones: only the new ones count
    mixed = draw_recording(tmp_path / "mixed", cameras=3, frames=5, seed=9)
    for name in ("C1", "C2", "C3"):
        for kind in ("color", "depth"):
            shutil.copy(drawn / "recording" / name / kind / "000003.png", mixed / name / kind / "100003.png")
    out = run("verify", tmp_path / "rig.yaml", mixed, "--json")
    assert out.status == 0 and json.loads(out.stdout)["frames"] == 5
    assert "Held out: 1 of 6 frames" in out.stderr
    # a rig file from before images were hashed is compared as a whole
    rig = read_rig(tmp_path / "rig.yaml")
    del rig.provenance["images_sha256"]
    write_rig(tmp_path / "old.yaml", rig)
    assert run("verify", tmp_path / "old.yaml", *arguments(drawn)).status == 2


@pytest.mark.parametrize("name", ["C1", "C2"])
def test_update_poses_one_camera_and_leaves_every_other_byte(run, drawn, tmp_path, name):
    rig = displaced(drawn, tmp_path / "rig.yaml", name, 0.05)
    # another program's spelling of numbers, and a comment, must survive too
    text = rig.read_text().replace("fx: 575.0", "fx: 5.75e+2  # measured", 3)
    rig.write_text(text)
    before = blocks(rig)
    out = run("calibrate", *arguments(drawn), "--update", rig, "--only", name, "-o", tmp_path / "new.yaml")
    assert out.status == 0, out.stderr
    after = blocks(tmp_path / "new.yaml")
    assert list(before) == list(after)
    assert {c for c in before if before[c] != after[c]} == {name}
    updated, true = read_rig(tmp_path / "new.yaml"), read_rig(drawn / "rig.yaml")
    error = se3.difference(updated.cameras[name].T_world_color, true.cameras[name].T_world_color)
    sd = np.sqrt(np.diag(updated.cameras[name].covariance))
    # 5 standard deviations, and 1 mm and 0.05 degrees for what drawing leaves on the pixels
    assert np.all(np.abs(error) < 5 * sd + [1e-3] * 6)
    assert updated.cameras[name].intrinsics == LENS
    assert updated.quality.expected_alignment is None
    (told,) = updated.quality.updates
    assert told.camera == name and told.moved_mm == pytest.approx(50, abs=1.5)
    assert run("verify", tmp_path / "new.yaml", *arguments(drawn)).status == 0


def test_update_again_keeps_the_first_report(run, drawn, tmp_path):
    for name in ("C2", "C3"):
        source = tmp_path / "rig.yaml" if name == "C3" else drawn / "rig.yaml"
        args = ("--update", source, "--only", name, "-o", tmp_path / "rig.yaml", "--overwrite")
        assert run("calibrate", *arguments(drawn), *args).status == 0
    assert [u.camera for u in read_rig(tmp_path / "rig.yaml").quality.updates] == ["C2", "C3"]


def test_update_adds_a_camera_that_the_rig_lacks(run, drawn, tmp_path):
    rig = read_rig(drawn / "rig.yaml")
    write_rig(tmp_path / "two.yaml", replace(rig, cameras={c: rig.cameras[c] for c in ("C1", "C2")}))
    before = blocks(tmp_path / "two.yaml")
    lens = ("--intrinsics", drawn / "intrinsics.yaml")
    out = run(
        "calibrate",
        *arguments(drawn),
        "--update",
        tmp_path / "two.yaml",
        "--only",
        "C3",
        *lens,
        "-o",
        tmp_path / "r.yaml",
    )
    assert out.status == 0 and "C3: added" in out.stdout
    after = blocks(tmp_path / "r.yaml")
    assert list(after) == ["C1", "C2", "C3"] and all(after[c] == before[c] for c in before)
    error = se3.difference(read_rig(tmp_path / "r.yaml").cameras["C3"].T_world_color, rig.cameras["C3"].T_world_color)
    sd = np.sqrt(np.diag(read_rig(tmp_path / "r.yaml").cameras["C3"].covariance))
    assert np.all(np.abs(error) < 5 * sd + 1e-3)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--only", "C2", "-o", "x.yaml"), "--update"),
        (("--update", "RIG", "-o", "x.yaml"), "--only CAMERA"),
        (("--update", "RIG", "--only", "C2", "--world", "floor", "-o", "x.yaml"), "--only CAMERA"),
        (("--update", "RIG", "--only", "C9", "-o", "x.yaml"), "the recording has C1, C2, C3"),
        (("--update", "RIG", "--only", "C2"), "--overwrite"),
        (("--update", "RIG", "--world", "C9", "-o", "x.yaml"), "cameras are C1, C2, C3"),
        (("--update", "RIG", "--world", "board:7", "-o", "x.yaml"), "Nearest: 00000"),
        (("--world", "C2", "--reference", "C1", "-o", "x.yaml"), "one camera"),
        ((), "-o FILE"),
    ],
)
def test_refuses_what_makes_no_sense(run, drawn, tmp_path, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    out = run("calibrate", *arguments(drawn), *[drawn / "rig.yaml" if o == "RIG" else o for o in options])
    assert out.status == 2 and words in out.stderr
    assert not Path("x.yaml").exists()


def test_update_refuses_others_that_no_longer_fit_each_other(run, drawn, tmp_path):
    rig = displaced(drawn, tmp_path / "rig.yaml", "C1", 0.04)
    out = run("calibrate", *arguments(drawn), "--update", rig, "--only", "C3", "-o", tmp_path / "x.yaml")
    assert out.status == 1 and "Calibrate the whole rig" in out.stderr


def check_world(moved, boards, old):
    """Everything but the world is as it was, covariances included."""
    T = moved.cameras["C1"].T_world_color
    Ad = se3.adjoint(T)
    for name, own in old.cameras.items():
        assert np.allclose(moved.cameras[name].T_world_color, T @ own.T_world_color, atol=1e-12)
        assert np.allclose(moved.cameras[name].covariance, Ad @ own.covariance @ Ad.T, atol=1e-15)
    assert not moved.cameras["C1"].covariance.any()


def test_a_finished_rig_moves_into_the_boards_world(run, drawn, tmp_path):
    out = run(
        "calibrate",
        *arguments(drawn),
        "--update",
        drawn / "rig.yaml",
        "--world",
        "board:000002",
        "-o",
        tmp_path / "w.yaml",
    )
    assert out.status == 0
    moved, boards = read_rig(tmp_path / "w.yaml"), read_boards(tmp_path / "w.yaml")
    assert np.allclose(boards["000002"], np.eye(4), atol=1e-12)
    check_world(moved, boards, read_rig(drawn / "rig.yaml"))
    assert moved.quality.world == "board:000002"
    assert run("verify", tmp_path / "w.yaml", *arguments(drawn)).status == 0


def test_calibrate_in_the_boards_world_and_in_a_cameras(run, drawn, tmp_path):
    common = ("calibrate", *arguments(drawn), "--intrinsics", drawn / "intrinsics.yaml")
    assert run(*common, "-o", tmp_path / "plain.yaml").status == 0
    assert run(*common, "--world", "board:000001", "-o", tmp_path / "board.yaml").status == 0
    assert run(*common, "--world", "C2", "-o", tmp_path / "c2.yaml").status == 0
    plain, board, second = (read_rig(tmp_path / f"{name}.yaml") for name in ("plain", "board", "c2"))
    check_world(board, read_boards(tmp_path / "board.yaml"), plain)
    assert np.allclose(read_boards(tmp_path / "board.yaml")["000001"], np.eye(4), atol=1e-12)
    assert second.reference == "C2" and np.array_equal(second.cameras["C2"].T_world_color, np.eye(4))
    assert not second.cameras["C2"].covariance.any() and second.cameras["C1"].covariance.any()
    truth = ("--truth", drawn / "rig.yaml", "--json")
    same = [json.loads(run("evaluate", tmp_path / f"{name}.yaml", *truth).stdout)["all"] for name in ("plain", "board")]
    assert same[0]["mean_mm"] == pytest.approx(same[1]["mean_mm"], rel=1e-6)


def test_calibrate_keeps_what_a_snapshot_says_beside_the_rig(run, drawn, tmp_path):
    out = tmp_path / "rig.yaml"
    args = ("--intrinsics", drawn / "intrinsics.yaml", "--method", "init", "-o", out)
    result = run("calibrate", *arguments(drawn), *args, "--snapshot", drawn / "recording")
    assert result.status == 0 and "Kept the snapshot in" in result.stderr, result.stderr
    kept, source = open_recording(tmp_path / "rig.snapshot"), open_recording(drawn / "recording")
    assert kept.frames == ("000000",) and kept.board is None and set(kept.cameras) == {"C1", "C2", "C3"}
    first = source.frames[0]
    assert np.array_equal(kept.color("C1", "000000"), source.color("C1", first))
    assert np.isfinite(kept.depth_m("C1", "000000")).any()
    again = run("calibrate", *arguments(drawn), *args, "--overwrite", "--snapshot", tmp_path / "none")
    assert again.status == 2 and "no such folder" in again.stderr

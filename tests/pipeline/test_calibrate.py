"""The whole calibration, from corners to a rig file: every method, odd recordings, the same bytes again, real data."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic_views import (
    BOARD,
    EVEN_BOARD,
    TWO_SIDED,
    arc,
    make_recording,
    pose_errors,
    ring,
    turn_some,
)

from rgbd_calib.geometry import so3
from rgbd_calib.io.correspondences import read_corners, write_corners
from rgbd_calib.io.files import load_yaml
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_boards, read_rig
from rgbd_calib.pipeline.evaluate import against_truth
from rgbd_calib.quality import Counted
from rgbd_calib.types import Rig

METHODS = ("init", "ba", "icp", "baicp+", "biobjective", "bundle")
MAX_MM = {"init": 5.0, "ba": 5.0, "icp": 1.2, "baicp+": 1.2, "biobjective": 1.2, "bundle": 2.0}
"""Mean alignment over the volume, with 0.1 px and 2.8 mm of depth at 2 m on about 300 corners a pair. A pose by its depths
is known to 2.8 mm sqrt(2 / 300) = 0.23 mm in the middle of the board's places and to three times that at their ends, over
chains of two pairs: 0.4 mm in the mean, three times that. The DLT is several times worse, and gives `ba` its scale. The
bundle does not believe a lens of a file without standard deviations to more than 0.5 %: its depths give it 0.6 to 1.2 mm in
larger studies."""


@pytest.fixture(scope="module")
def three(tmp_path_factory):
    return make_recording(tmp_path_factory.mktemp("three"), arc(3, biased=True))


def alignment_mm(rig: Rig, recording) -> float:
    return 1e3 * float(against_truth(rig, recording.rig, recording.boards, BOARD).distance_m.mean())


def calibrated(run, recording, output: Path, *args, given: bool = True) -> Rig:
    sources = ["--intrinsics", recording.intrinsics] if given else []
    if given and recording.depth_bias.exists():
        sources += ["--depth-bias", recording.depth_bias]
    out = run("calibrate", recording.path, "--corners", recording.corners, *sources, *args, "-o", output)
    assert out.status == 0, out.stderr
    return read_rig(output)


@pytest.mark.parametrize("method", METHODS)
def test_every_method(run, three, tmp_path, method):
    rig = calibrated(run, three, tmp_path / "rig.yaml", "--method", method)
    assert list(rig.cameras) == ["C1", "C2", "C3"]
    assert rig.reference == "C1"
    np.testing.assert_array_equal(rig.cameras["C1"].T_world_color, np.eye(4))
    assert alignment_mm(rig, three) < MAX_MM[method]
    assert rig.quality.method == method
    assert rig.quality.views_used == {n: sum(v.camera == n for v in three.views) for n in rig.cameras}
    assert rig.provenance["config"]["method"] == method
    assert rig.provenance["recording_sha256"] == open_recording(three.path).digest()
    assert (tmp_path / "rig.residuals.csv").exists()
    assert set(read_boards(tmp_path / "rig.yaml")) == set(three.boards)


def test_from_nothing_but_the_recording(run, three, tmp_path):
    """Intrinsics from the recording's own views; the depth of a rig whose bias nobody knows."""
    rig = calibrated(run, three, tmp_path / "rig.yaml", given=False)
    assert rig.provenance["intrinsics"] == "the recording's own views"
    assert alignment_mm(rig, three) < MAX_MM["bundle"]
    for name, camera in rig.cameras.items():
        assert camera.depth_bias is not None, name


@pytest.mark.parametrize("method", ["ba", "biobjective"])
def test_the_papers_methods_with_lenses_depth_and_board_of_the_bundle(run, three, tmp_path, method):
    """The depth is biased, which without a bias recording only the bundle finds out."""
    rig = {
        start: calibrated(run, three, tmp_path / f"{start}.yaml", "--method", method, "--start", start, given=False)
        for start in ("given", "bundle")
    }
    bundle = calibrated(run, three, tmp_path / "rig.yaml", given=False)
    for name, own in rig["bundle"].cameras.items():
        assert own.intrinsics == bundle[name].intrinsics != rig["given"][name].intrinsics
        assert own.depth_bias.coefficients == bundle[name].depth_bias.coefficients
        assert rig["given"][name].depth_bias is None
    assert alignment_mm(rig["bundle"], three) < MAX_MM["bundle"] < alignment_mm(rig["given"], three)
    assert rig["bundle"].quality.message.endswith("lenses, depth and board of the bundle, taken as exact")
    assert rig["given"].quality.message.endswith("lenses, depth and board as given, taken as exact")


def test_the_bundle_does_not_start_from_itself(run, three, tmp_path):
    out = run("calibrate", three.path, "--corners", three.corners, "--start", "bundle", "-o", tmp_path / "rig.yaml")
    assert out.status != 0
    assert "--start bundle" in out.stderr


@pytest.mark.parametrize("method", ["biobjective", "bundle"])
@pytest.mark.parametrize("colour_only", ["C1", "C2"])
def test_a_camera_with_colour_only(run, tmp_path, method, colour_only):
    recording = make_recording(tmp_path, arc(3), color_only=[colour_only])
    rig = calibrated(run, recording, tmp_path / "rig.yaml", "--method", method)
    for name, (rotation_rad, shift_m) in pose_errors(
        {n: c.T_world_color for n, c in rig.cameras.items()}, recording.rig
    ).items():
        assert rotation_rad < np.radians(0.3), name
        assert shift_m < 0.012, name  # 0.3 degrees at 2 m


@pytest.mark.parametrize("method", METHODS)
def test_two_cameras_with_names_of_their_own(run, tmp_path, method):
    recording = make_recording(tmp_path, arc(2, names=["rechts", "0815"]), frames=10)
    rig = calibrated(run, recording, tmp_path / "rig.yaml", "--method", method, "--reference", "0815")
    assert list(rig.cameras) == ["rechts", "0815"]
    assert rig.reference == "0815"
    np.testing.assert_array_equal(rig.cameras["0815"].T_world_color, np.eye(4))
    assert alignment_mm(rig, recording) < MAX_MM[method]


def test_missing_frames(run, tmp_path):
    """A quarter of the images is not there, and some have no depth."""
    recording = make_recording(tmp_path, arc(3), frames=18)
    gone = [v for i, v in enumerate(recording.views) if i % 4 == 1]
    for view in gone:
        (recording.path / view.camera / "color" / f"{view.frame}.png").unlink()
        (recording.path / view.camera / "depth" / f"{view.frame}.png").unlink()
    left = [v for i, v in enumerate(recording.views) if i % 4 != 1]
    blind = [
        replace(v, depth_m=np.full(len(v.ids), np.nan), depth_pixels=0 * v.depth_pixels) if i % 5 == 0 else v
        for i, v in enumerate(left)
    ]
    write_corners(recording.corners, blind)
    rig = calibrated(run, recording, tmp_path / "rig.yaml")
    assert alignment_mm(rig, recording) < MAX_MM["bundle"]


def test_a_ring_with_a_two_sided_board(run, tmp_path):
    recording = make_recording(tmp_path, ring(4), TWO_SIDED, frames=20)
    rig = calibrated(run, recording, tmp_path / "rig.yaml")
    assert rig.quality.back_views > 0
    errors = pose_errors({n: c.T_world_color for n, c in rig.cameras.items()}, recording.rig)
    # opposed cameras meet by the board's two faces only: 0.3 degrees over 4 m
    assert max(shift_m for _, shift_m in errors.values()) < 0.02


@pytest.mark.parametrize("method", ["biobjective", "bundle"])
def test_an_even_board_read_from_either_end(run, tmp_path, method):
    recording = make_recording(tmp_path, arc(3), EVEN_BOARD)
    views, turned = turn_some(recording.views, EVEN_BOARD, 0.35, np.random.default_rng(1))
    write_corners(recording.corners, views)
    rig = calibrated(run, recording, tmp_path / "rig.yaml", "--method", method)
    assert len(turned) > 5
    assert sum(rig.quality.views_used.values()) == len(views)
    assert alignment_mm(rig, recording) < MAX_MM[method]


def test_a_board_133_px_off_does_not_matter(run, three, tmp_path):
    views = list(three.views)
    at = next(i for i, v in enumerate(views) if v.camera == "C2" and sum(w.frame == v.frame for w in views) == 3)
    views[at] = replace(views[at], corners_px=views[at].corners_px + [133.0, 0.0])
    corners = tmp_path / "corners.csv"
    write_corners(corners, views)
    rig = calibrated(run, replace(three, corners=corners), tmp_path / "rig.yaml")
    assert alignment_mm(rig, three) < MAX_MM["bundle"]
    dropped = {**rig.quality.views_not_associated, **rig.quality.dropped}
    assert views[at].frame in dropped["C2"]


@pytest.mark.parametrize("method", ["biobjective", "bundle"])
def test_the_same_bytes_again_whatever_the_jobs(run, three, tmp_path, method):
    """Lenses from the recording's own views too."""
    texts = []
    for jobs in (1, 1, 3) if method == "bundle" else (1, 3):
        rig = tmp_path / "rig.yaml"
        calibrated(run, three, rig, "--method", method, "--jobs", jobs, "--overwrite", given=False)
        texts.append(rig.read_text())
    assert texts[0] == texts[-2]
    assert texts[-1] == texts[0].replace("--jobs 1", "--jobs 3")  # the command line is in the file


def test_matched_features_go_on_to_refine(run, three, tmp_path):
    c = tmp_path / "c.csv"
    first = calibrated(run, three, tmp_path / "rig.yaml", "--method", "biobjective", "--correspondences", c)
    out = run("refine", c, "--intrinsics", three.intrinsics, "-o", tmp_path / "refined.yaml")
    assert out.status == 0, out.stderr
    again = read_rig(tmp_path / "refined.yaml")
    for name, camera in first.cameras.items():
        np.testing.assert_allclose(again.cameras[name].T_world_color, camera.T_world_color, atol=1e-9)
    assert "sigma_2D" in out.stderr


def test_the_end_says_all_that_matters_and_json_gives_it_to_programs(run, three, tmp_path):
    given = ("--intrinsics", three.intrinsics, "--corners", three.corners)
    out = run("calibrate", three.path, *given, "-o", tmp_path / "a.yaml")
    for words in ("Expected error: ", "Measured on this recording: ", "Verdict: Good"):
        assert words in out.stderr, words
    assert "views, 0." in out.stdout and "reference" in out.stdout
    common = ("calibrate", three.path, *given, "--json", "--quiet")
    out = run(*common, "-o", tmp_path / "b.yaml")
    numbers = json.loads(out.stdout)
    assert out.stderr == "" and numbers["verdict"] == "good"
    assert set(numbers["cameras"]) == set(read_rig(tmp_path / "b.yaml").cameras)


def test_refine_is_judged_in_millimetres(run, three, tmp_path):
    """A depth that is 2 % too long is 40 mm off at 2 m: the rig may be written, but not as a good one."""
    c = tmp_path / "c.csv"
    calibrated(run, three, tmp_path / "rig.yaml", "--method", "init", "--correspondences", c)
    given = ("--intrinsics", three.intrinsics)
    out = run("refine", c, *given, "-o", tmp_path / "right.yaml")
    assert out.status == 0 and "Verdict: Good" in out.stderr
    quality = read_rig(tmp_path / "right.yaml").quality
    assert 1 < quality.working_distance_m < 3 and quality.expected_alignment.of is Counted.POSES
    head, *rows = c.read_text().splitlines()
    at = head.split(",").index("x_m")
    spoilt = [row.split(",") for row in rows]
    for row in spoilt:
        if row[0] == "C2" and row[at]:
            row[at:] = [str(1.02 * float(value)) for value in row[at:]]
    (tmp_path / "spoilt.csv").write_text("\n".join([head, *map(",".join, spoilt)]) + "\n")
    out = run("refine", tmp_path / "spoilt.csv", *given, "-o", tmp_path / "wrong.yaml")
    assert out.status == 0 and "Verdict: " in out.stderr and "Verdict: Good" not in out.stderr
    assert read_rig(tmp_path / "wrong.yaml").quality.alignment_on_recording.all.median_mm > 6


def test_colour_alone_gets_pixels_and_millimetres_at_the_board(run, tmp_path):
    recording = make_recording(tmp_path, arc(3), color_only=["C1", "C2", "C3"])
    rig = calibrated(run, recording, tmp_path / "rig.yaml")
    measured = rig.quality.alignment_on_recording.all
    assert 0 < measured.median_px < 1 and 0 < measured.median_board_mm < 3 and measured.median_mm is None


@pytest.mark.parametrize("method", ["init", "ba", "icp", "baicp+"])
def test_refine_by_each_method(run, three, tmp_path, method):
    c = tmp_path / "c.csv"
    calibrated(run, three, tmp_path / "rig.yaml", "--method", "init", "--correspondences", c)
    out = run("refine", c, "--intrinsics", three.intrinsics, "--method", method, "-o", tmp_path / "refined.yaml")
    assert out.status == 0, out.stderr
    errors = pose_errors(
        {n: c.T_world_color for n, c in read_rig(tmp_path / "refined.yaml").cameras.items()}, three.rig
    )
    # the alignment's bound, as a turn of cameras 2 m away; the refined file itself knows no depth bias
    assert max(rotation_rad for rotation_rad, _ in errors.values()) < MAX_MM[method] * 1e-3
    assert max(shift_m for _, shift_m in errors.values()) < 3e-3 * MAX_MM[method]


def test_known_sigmas_and_a_config_file(run, three, tmp_path):
    config = tmp_path / "config.yaml"
    config.write_text("method: biobjective\nreference: C2\nrefinement: {sigma_2d_px: 0.1}\n")
    rig = calibrated(run, three, tmp_path / "rig.yaml", "--config", config, "--sigma-3d", "0.003")
    assert rig.reference == "C2"
    assert rig.quality.sigma_2d_px == 0.1
    assert rig.quality.sigma_3d_m == 0.003
    assert rig.quality.w == pytest.approx(2 * 0.003**2 / 0.1**2)  # eq. 4.5
    assert rig.provenance["config"]["refinement"]["sigma_3d_m"] == 0.003


def realsense(real_data, tmp_path, run, *args) -> tuple[dict, str]:
    out = run("calibrate", real_data("realsense3"), *args, "-o", tmp_path / "rig.yaml")
    assert out.status == 0, out.stderr
    return load_yaml(tmp_path / "rig.yaml"), out.stderr


@pytest.fixture(scope="session")
def realsense_corners(real_data, tmp_path_factory):
    """Corners of realsense3, found once."""
    from rgbd_calib.pipeline.detection import detect
    from rgbd_calib.views.detect import DetectParams

    path = tmp_path_factory.mktemp("realsense") / "corners.csv"
    write_corners(path, detect(open_recording(real_data("realsense3")), DetectParams()).views)
    return path


def check_realsense(rig: dict) -> None:
    """15 of 16 shots are seen by two cameras; the bundle's median alignment, by single depths, is 2.8 mm held out."""
    assert rig["quality"]["views_used"] == {"cam0": 10, "cam1": 9, "cam2": 11}
    assert not rig["quality"]["views_not_associated"]
    assert not rig["quality"]["dropped"]
    assert len(rig["boards"]) == 15
    assert rig["quality"]["alignment_on_recording"]["all"]["median_mm"] < 3.5
    # frames 001 to 004 are all that tie cam0 to cam1: without them the rig is loose, which is no other rig
    assert rig["quality"]["self_check"]["trusted"], rig["quality"]["self_check"]["findings"]


def test_realsense3(run, real_data, realsense_corners, tmp_path):
    rig, _ = realsense(real_data, tmp_path, run, "--corners", realsense_corners)
    check_realsense(rig)


@pytest.mark.parametrize("share", [0.1, 0.25, 0.4])
def test_realsense3_with_views_read_from_the_other_end(run, real_data, realsense_corners, tmp_path, share):
    board = open_recording(real_data("realsense3")).board
    views, turned = turn_some(read_corners(realsense_corners), board, share, np.random.default_rng(0))
    assert turned
    write_corners(tmp_path / "corners.csv", views)
    rig, _ = realsense(real_data, tmp_path, run, "--corners", tmp_path / "corners.csv")
    check_realsense(rig)


@pytest.mark.parametrize("method", ["biobjective", "bundle"])
def test_percipio4_vga(run, real_data, tmp_path, method):
    """One shot: planar first poses. The published extrinsics are good to 0.3 degrees and 7 mm; the bundle, which does not
    take lens and depth for exact, says itself how much is left open."""
    folder = real_data("percipio4_vga")
    out = run("calibrate", folder, "--method", method, "-o", tmp_path / "rig.yaml")
    assert out.status == 0, out.stderr
    rig, published = read_rig(tmp_path / "rig.yaml"), load_yaml(folder / "published.yaml")["cameras"]
    assert rig.reference == "left_top"
    assert set(rig.cameras) == set(published)
    for name, camera in rig.cameras.items():
        T = np.array(published[name]["T_left_top_camera"])
        variance = np.diag(camera.covariance)
        sd_deg, sd_m = np.degrees(np.sqrt(variance[:3].sum())), np.sqrt(variance[3:].sum())
        off_deg = np.degrees(so3.angle_rad(camera.T_world_color[:3, :3].T @ T[:3, :3]))
        assert off_deg < max(0.5, 0.3 + 2 * sd_deg), name
        assert np.linalg.norm(camera.T_world_color[:3, 3] - T[:3, 3]) < max(0.020, 0.007 + 2 * sd_m), name

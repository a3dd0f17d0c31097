"""Evaluation: nothing against itself, a known displacement, noise-free views; and its command."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from synthetic_views import (
    BOARD,
    EXACT,
    TWO_SIDED,
    arc,
    board_poses,
    make_recording,
    placed_truly,
    ring,
    turn_some,
    without_depth,
)

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.io.rig import write_rig
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.evaluate import against_truth, against_views, place_views
from rgbd_calib.pipeline.world import moved_rig
from rgbd_calib.quality import Counted, ExpectedAlignment, JointErrors
from rgbd_calib.simulation.views import true_views
from rgbd_calib.trust.uncertainty import JointCovariance
from rgbd_calib.types import Rig

RIG = arc(3, biased=True)
RNG = np.random.default_rng(0)
BOARDS = board_poses(RIG, BOARD, 8, RNG)


def moved(rig: Rig, name: str, xi: list[float]) -> Rig:
    own = rig.cameras[name]
    camera = replace(own, T_world_color=se3.retract(own.T_world_color, np.array(xi)))
    return replace(rig, cameras={**rig.cameras, name: camera})


def everywhere(rig: Rig, T: np.ndarray) -> Rig:
    """The same rig in another world."""
    cameras = {n: replace(c, T_world_color=T @ c.T_world_color) for n, c in rig.cameras.items()}
    return replace(rig, cameras=cameras)


@pytest.mark.parametrize(("boards", "board"), [(BOARDS, BOARD), ({}, None)], ids=["boards", "frustums"])
def test_the_truth_has_no_error(boards, board):
    result = against_truth(RIG, RIG, boards, board)
    assert {p.cameras for p in result.pairs} == {("C1", "C2"), ("C1", "C3"), ("C2", "C3")}
    assert result.distance_m.max() < 1e-9
    assert set(result.poses) == {"C2", "C3"}
    assert all(e.rotation_rad < 1e-7 and e.translation_m < 1e-12 for e in result.poses.values())


def test_a_camera_moved_by_5_mm_shows_5_mm():
    result = against_truth(moved(RIG, "C2", [0, 0, 0, 0, 0.005, 0]), RIG, BOARDS, BOARD)
    for pair in result.pairs:
        np.testing.assert_allclose(pair.distance_m, 0.005 if "C2" in pair.cameras else 0.0, atol=1e-9)
    baseline = np.linalg.norm(RIG.cameras["C2"].T_world_color[:3, 3])
    assert result.poses["C2"].translation_m == pytest.approx(0.005)
    assert result.poses["C2"].relative_translation == pytest.approx(0.005 / baseline)
    assert result.poses["C2"].rotation_rad == pytest.approx(0, abs=1e-7)
    summary = result.summary()
    assert summary.pairs["C1 - C2"].mean_mm == pytest.approx(5.0)
    assert summary.poses["C2"].translation_mm == pytest.approx(5.0)
    assert sum(n.points for n in summary.by_distance.values()) == summary.all.points


def test_what_the_rig_states_is_of_the_same_points():
    own = {name: {"pose": np.arange(6) + 6 * i} for i, name in enumerate(RIG.cameras)}
    C = np.zeros((18, 18))
    C[9:12, 9:12] = 1e-6 * np.eye(3)  # C2 may be 1 mm off in each direction
    stated = ExpectedAlignment(Counted.POSES, 0.0, 0.0, 0.0, {}, None, JointCovariance(C, own).kept())
    rig = replace(RIG, quality=replace(RIG.quality, expected_alignment=stated))
    T = se3.retract(np.eye(4), np.array([0.3, -1.0, 2.0, 5.0, 6.0, 7.0]))
    for seen in (rig, moved_rig(rig, T, "board", None)):
        summary = against_truth(moved(seen, "C2", [0, 0, 0, 0, 0.005, 0]), RIG, BOARDS, BOARD).summary()
        of_c2 = np.sqrt(8 / np.pi)  # mean length of a normal vector in space
        for name, pair in summary.pairs.items():
            assert pair.expected_mm == pytest.approx(of_c2 if "C2" in name else 0.0, rel=2e-3, abs=1e-9)
        assert summary.all.expected_mm == pytest.approx(
            sum(p.expected_mm * p.points for p in summary.pairs.values()) / summary.all.points, rel=1e-2
        )
    assert against_truth(RIG, RIG, BOARDS, BOARD).summary().all.expected_mm is None


def test_a_turned_camera_shows_its_angle():
    result = against_truth(moved(RIG, "C3", [0, 0.01, 0, 0, 0, 0]), RIG, BOARDS, BOARD)
    assert result.poses["C3"].rotation_rad == pytest.approx(0.01)


def test_the_world_does_not_matter():
    T = se3.retract(np.eye(4), np.array([0.3, -1.0, 2.0, 5.0, 6.0, 7.0]))
    result = against_truth(everywhere(RIG, T), RIG, BOARDS, BOARD)
    assert result.distance_m.max() < 1e-9
    assert max(e.translation_m for e in result.poses.values()) < 1e-12


def test_a_wrong_depth_bias_shows():
    off = replace(RIG, cameras={**RIG.cameras, "C1": replace(RIG.cameras["C1"], depth_bias=None)})
    result = against_truth(off, RIG, BOARDS, BOARD)
    pair = next(p for p in result.pairs if p.cameras == ("C1", "C2"))
    bias = RIG.cameras["C1"].depth_bias
    # along the ray, at most 1 / cos(35 degrees) = 1.22 times the depth's error
    most = max(abs(bias.correct(z) - z) for z in np.linspace(1.2, 3.0, 50))
    assert 0.5e-3 < pair.distance_m.max() < 1.25 * most


def test_a_damaged_joint_covariance_is_named():
    damaged = JointErrors({name: {"pose": 6} for name in RIG.cameras}, (1.0,) * 17, "")
    stated = ExpectedAlignment(Counted.POSES, 0.0, 0.0, 0.0, {}, None, damaged)
    rig = replace(RIG, quality=replace(RIG.quality, expected_alignment=stated))
    for use in (lambda: against_truth(rig, RIG, BOARDS, BOARD), lambda: moved_rig(rig, np.eye(4), "board", None)):
        with pytest.raises(CalibrationError, match=r"quality.expected_alignment.joint is damaged: 17 .* 18 parameters"):
            use()


def test_truth_of_another_rig():
    other = arc(3, names=["a", "b", "c"])
    with pytest.raises(ConfigError, match="the truth has no camera C1, C2, C3; seen: a, b, c"):
        against_truth(RIG, other, BOARDS, BOARD)


@pytest.mark.parametrize(("rig", "board"), [(RIG, BOARD), (ring(4, biased=True), TWO_SIDED)], ids=["arc", "ring"])
def test_noise_free_views_agree(rig, board):
    rng = np.random.default_rng(1)
    boards = board_poses(rig, board, 6, rng)
    views = true_views(rig, boards, board, EXACT, rng)
    result = against_views(rig, placed_truly(rig, boards, views, board), board)
    assert result.distance_m.max() < 1e-7
    assert max(p.transfer_px.max() for p in result.pairs) < 1e-6
    # and placed by their own pixels, whichever end they were read from
    placed = place_views(rig, views, board, list(rig.cameras), Config())
    assert len(placed) == len(views)
    again = against_views(rig, placed, board)
    assert again.distance_m.max() < 1e-4
    assert max(p.transfer_px.max() for p in again.pairs) < 0.01


def test_half_turned_views_are_read_right():
    board = replace(BOARD, cols=10)
    rng = np.random.default_rng(2)
    boards = board_poses(RIG, board, 8, rng)
    views, turned = turn_some(true_views(RIG, boards, board, EXACT, rng), board, 0.4, rng)
    assert turned
    result = against_views(RIG, place_views(RIG, views, board, list(RIG.cameras), Config()), board)
    assert result.distance_m.max() < 1e-4


def test_views_show_a_displacement_in_mm_and_px():
    rng = np.random.default_rng(3)
    views = true_views(RIG, BOARDS, BOARD, EXACT, rng)
    rig = moved(RIG, "C2", [0, 0, 0, 0.005, 0, 0])
    result = against_views(rig, placed_truly(RIG, BOARDS, views, BOARD), BOARD)
    for pair in result.pairs:
        np.testing.assert_allclose(pair.distance_m, 0.005 if "C2" in pair.cameras else 0.0, atol=1e-7)
        if "C2" in pair.cameras:
            # 5 mm across the line of sight (less what lies along it) at 1.4 to 2.8 m, f = 540 to 560 px
            assert 0.8 < np.median(pair.transfer_px) < 2.2


def test_colour_only_views_have_a_transfer_error_alone():
    rng = np.random.default_rng(4)
    views = [without_depth(v) for v in true_views(RIG, BOARDS, BOARD, EXACT, rng)]
    summary = against_views(RIG, placed_truly(RIG, BOARDS, views, BOARD), BOARD).summary()
    assert summary.all.points == 0
    assert summary.all.median_px < 1e-6


def test_nothing_in_common():
    rng = np.random.default_rng(5)
    views = [v for v in true_views(RIG, BOARDS, BOARD, EXACT, rng) if v.camera == "C1"]
    with pytest.raises(CalibrationError, match=r"no frame shows the board to two cameras .* Film the board between"):
        against_views(RIG, placed_truly(RIG, BOARDS, views, BOARD), BOARD)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return make_recording(tmp_path_factory.mktemp("evaluate"), RIG, frames=6)


def test_command_against_the_truth(run, recording, tmp_path):
    rig = tmp_path / "rig.yaml"
    write_rig(rig, moved(RIG, "C2", [0, 0, 0, 0.005, 0, 0]))
    out = run("evaluate", rig, "--truth", recording.truth)
    assert out.status == 0
    assert "C2: rotation 0.0000°, translation 5.000 mm" in out.stdout
    numbers = json.loads(run("evaluate", rig, "--truth", recording.truth, "--json").stdout)
    assert numbers["pairs"]["C1 - C2"]["median_mm"] == pytest.approx(5.0, abs=1e-6)


def test_command_against_a_recording(run, recording):
    out = run("evaluate", recording.truth, "--recording", recording.path, "--corners", recording.corners, "--json")
    assert out.status == 0
    numbers = json.loads(out.stdout)["all"]
    # depth noise of 0.7e-3 z^2 in two cameras 20 or 40 degrees apart, 1.5 to 2.6 m away: median of the longer of them
    assert 1.0 < numbers["median_mm"] < 6.0
    # 0.1 px in the target, as much from the pose of a whole board in the source and its lever
    assert numbers["median_px"] < 0.4


@pytest.mark.parametrize("args", [(), ("--truth", "a", "--recording", "b")])
def test_command_needs_one_thing_to_compare_with(run, recording, args):
    out = run("evaluate", recording.truth, *args)
    assert out.status == 2
    assert "give one of --truth FILE, --recording RECORDING and --clouds RECORDING" in out.stderr


def test_command_with_another_rig(run, recording, tmp_path):
    path = tmp_path / "other.yaml"
    write_rig(path, arc(2, names=["left", "right"]))
    for args in (("--truth", recording.truth), ("--recording", recording.path, "--corners", recording.corners)):
        out = run("evaluate", path, *args)
        assert out.status == 2
        assert "left, right" in out.stderr
        assert "Traceback" not in out.stderr

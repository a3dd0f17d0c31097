"""Cameras against a rig by corners alone: who moved, by how much, and when nobody can say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.verify import fit_views, sentence, verify_views
from rgbd_calib.simulation.views import ViewNoise, true_views
from rgbd_calib.trust.displacement import VerdictParams, locate_cameras
from rgbd_calib.types import Board, DepthBias, Rig, RigCamera
from rgbd_calib.views.association import AssociationParams, label_views
from rgbd_calib.views.board_pose import pose_view

BOARD = Board(9, 6, 0.06, two_sided=True, thickness_m=0.006)
NOISE, LIMITS = ViewNoise(), VerdictParams()


def arc(n=4):
    """Cameras 0.9 m apart on an arc of radius 2.2 m that look at its centre; the world is the first."""
    centre = np.array([0.0, 0.0, 2.2])
    poses = []
    for i in range(n):
        R = so3.exp(np.array([0.0, -0.4 * i, 0.0]))
        poses.append(se3.make(R, centre - R @ centre))
    cameras = {
        f"C{i + 1}": RigCamera(
            Intrinsics(640, 480, 560.0 + i, 561.0, 318.0 + i, 241.0, (0.05, -0.1, 0.0, 0.001, 0.0)),
            T,
            np.zeros((6, 6)),
            DepthBias((0.004, -0.003, 0.002), 0.5, 5.0, 0.001),
        )
        for i, T in enumerate(poses)
    }
    return Rig("C1", cameras)


def board_poses(n, rng):
    """Boards about the arc's centre, turned to the middle of the arc and tilted."""
    out = {}
    for k in range(n):
        R = so3.exp(np.array([0.0, -0.6, 0.0])) @ so3.exp(rng.uniform(-0.35, 0.35, 3))
        place = np.array([0.0, 0.0, 2.2]) + rng.uniform(-0.3, 0.3, 3)
        out[f"{k:06d}"] = se3.make(R, place - R @ BOARD.corners_m().mean(axis=0))
    return out


def moved(rig, name, rotation_rad=(0, 0, 0), shift_m=(0, 0, 0)):
    """The rig with one camera moved about its own centre."""
    step = se3.retract(np.eye(4), np.array([*rotation_rad, *shift_m], float))
    own = rig.cameras[name]
    return replace(rig, cameras=rig.cameras | {name: replace(own, T_world_color=own.T_world_color @ step)})


def check(now, rig, seed=0, frames=5, noise=NOISE, spoil=None, params=LIMITS):
    """The verdict on `rig` by frames of the true rig `now`."""
    rng = np.random.default_rng(seed)
    views = true_views(now, board_poses(frames, rng), BOARD, noise, rng)
    if spoil is not None:
        views = spoil(views)
    return verify_views(rig, views, BOARD, tuple(rig.cameras), Config(), params)


@pytest.mark.parametrize("seed", range(3))
def test_a_rig_that_stood_still_holds(seed):
    result = check(arc(), arc(), seed)
    assert result.verdict.holds and not result.verdict.moved
    assert "PASS" in sentence(result.verdict)


@pytest.mark.parametrize("name", ["C1", "C2", "C3", "C4"])
@pytest.mark.parametrize(("turn", "shift"), [((0, 0, 0), (0.003, 0, 0.004)), ((0.0031, 0.0042, 0), (0, 0, 0))])
def test_names_the_camera_that_moved_by_5_mm_or_a_third_of_a_degree_and_the_reference_too(name, turn, shift):
    result = check(moved(arc(), name, turn, shift), arc(), seed=3)
    verdict = result.verdict
    assert verdict.moved == (name,) and not verdict.rivals and not verdict.holds
    (own,) = (m for m in verdict.displacements if m.camera == name)
    # 5 standard deviations of what the verdict itself claims
    assert own.shift_m == pytest.approx(np.linalg.norm(shift), abs=5 * own.shift_sd_m)
    assert own.turn_rad == pytest.approx(np.linalg.norm(turn), abs=5 * own.turn_sd_rad)
    assert all(p.broken == (name in p.cameras) for p in verdict.pairs)


def test_names_two_cameras_that_moved_differently():
    now = moved(moved(arc(), "C2", shift_m=(0, 0.02, 0)), "C4", shift_m=(0.02, 0, 0))
    verdict = check(now, arc(), frames=8).verdict
    assert verdict.moved == ("C2", "C4")


def test_of_two_cameras_it_says_that_nobody_can_tell():
    verdict = check(moved(arc(2), "C2", shift_m=(0.006, 0, 0)), arc(2)).verdict
    assert {verdict.moved, *verdict.rivals} == {("C1",), ("C2",)}
    assert "only two cameras" in sentence(verdict)


def test_finds_a_camera_that_was_kicked_far_away():
    verdict = check(moved(arc(), "C3", (0.0, 0.12, 0.05), (0.15, -0.1, 0.1)), arc(), frames=8).verdict
    assert verdict.moved == ("C3",)
    (own,) = (m for m in verdict.displacements if m.camera == "C3")
    assert own.shift_m == pytest.approx(np.sqrt(0.15**2 + 0.1**2 + 0.1**2), abs=5 * own.shift_sd_m)


def test_one_wrong_view_moves_no_camera():
    def shift(views):
        return tuple(
            replace(v, corners_px=v.corners_px + 12.0) if (v.camera, v.frame) == ("C2", "000001") else v for v in views
        )

    result = check(arc(), arc(), frames=6, spoil=shift)
    assert result.verdict.holds
    wrong = result.poses.shift_m["C2", "000001"]
    assert wrong > 5 * np.median(list(result.poses.shift_m.values()))


def test_frames_that_cannot_tell_are_no_pass():
    verdict = check(arc(), arc(), frames=2, noise=ViewNoise(0.8, 5e-3, 5e-3)).verdict
    assert verdict.blind and not verdict.holds and not verdict.moved
    assert "UNDECIDED" in sentence(verdict) and "more frames" in sentence(verdict)
    many = replace(verdict, blind=tuple((f"C{i}", "D1") for i in range(80)))
    assert "between C0 - D1, C1 - D1" in sentence(many) and "C5 - D1 and 74 more. Film" in sentence(many)


def test_says_which_camera_saw_nothing_together_with_the_others():
    result = check(arc(), arc(), spoil=lambda views: [v for v in views if v.camera != "C4"])
    assert result.verdict.unjoined == ("C4",) and not result.verdict.holds
    assert "C4 saw no board" in sentence(result.verdict)


def test_refuses_frames_that_compare_nothing():
    with pytest.raises(CalibrationError, match="nothing to compare"):
        check(arc(), arc(), spoil=lambda views: [v for v in views if v.camera == "C1"])


def test_a_larger_limit_lets_pass():
    now = moved(arc(), "C3", shift_m=(0.005, 0, 0))
    assert not check(now, arc()).verdict.holds
    assert check(now, arc(), params=VerdictParams(max_m=0.010)).verdict.holds


def test_the_covariance_of_the_poses_is_honest():
    """Mean of e' C^-1 e over 20 runs of 18 degrees of freedom each: 1 +- 5 sqrt(2 / 360) if C were known.

    C rests on sigmas estimated from the views themselves, and views with less than 1 in noise are never trusted
    more than assumed (the factor is at least 1): the claim may be up to 1.5 times too wide, in deviations.
    """
    rig, total, degrees = arc(), 0.0, 0
    T_world_color = {name: own.T_world_color for name, own in rig.cameras.items()}
    for seed in range(20):
        rng = np.random.default_rng(100 + seed)
        views = true_views(rig, board_poses(5, rng), BOARD, ViewNoise(), rng)
        posed = [pose_view(v, BOARD, rig.cameras[v.camera].intrinsics, rig.cameras[v.camera].depth_bias) for v in views]
        placed, _ = label_views(posed, BOARD, T_world_color, AssociationParams())
        poses = locate_cameras(fit_views(rig, placed, BOARD), T_world_color, "C1")
        error = np.concatenate([se3.difference(poses.T_world_color[c], T_world_color[c]) for c in poses.cameras[1:]])
        total += error @ np.linalg.solve(poses.covariance[6:, 6:], error)
        degrees += len(error)
    assert 1 / 1.5**2 < total / degrees < 1 + 5 * np.sqrt(2 / degrees)

"""The pose of a board in one view, and the flip that pixels cannot see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic_views import BOARD, lens_of, without_depth

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import camera, resection, se3, so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.types import Board, BoardView, DepthBias
from rgbd_calib.views.board_pose import BoardPoseParams, pose_view

SMALL = Board(9, 6, 0.015)
FAR = Intrinsics(640, 480, 575.0, 575.0, 319.5, 239.5)


def view_of(board: Board, lens: Intrinsics, T: np.ndarray, rng: np.random.Generator, sigma_px=0.1, k=0.7e-3):
    p = se3.transform(T, board.corners_m())
    n = board.n_corners
    px = camera.project(lens.vector, p) + rng.normal(0, sigma_px, (n, 2))
    return BoardView("C1", "000004", np.arange(n), px, p[:, 2] + rng.normal(0, k, n) * p[:, 2] ** 2, np.full(n, 30))


def tilted(board: Board, tilt_rad: float, z_m: float) -> np.ndarray:
    R = so3.exp(np.array([0.0, tilt_rad, 0.0]))
    return se3.make(R, np.array([0.05, 0.02, z_m]) - R @ board.corners_m().mean(axis=0))


@pytest.mark.parametrize("seed", range(10))
def test_pose_from_a_close_view(seed):
    rng = np.random.default_rng(seed)
    lens = lens_of(2)
    T = se3.retract(tilted(BOARD, 0.5, 1.2), rng.uniform(-0.2, 0.2, 6))
    posed = pose_view(view_of(BOARD, lens, T, rng), BOARD, lens, None)
    # covariance of the pose by the pixels alone
    p = se3.transform(T, BOARD.corners_m())
    _, J_point, _ = camera.project_jacobian(lens.vector, p)
    J = np.concatenate([-J_point @ so3.hat(p), J_point], axis=-1).reshape(-1, 6)
    sd = 0.1 * np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    # the planar homography weighs all rays alike, not all pixels: equal to 5 % within this field of view
    assert np.all(np.abs(se3.difference(posed.T_color_face, T)) < 6 * sd)
    assert posed.rms_px == pytest.approx(0.1, rel=0.35)  # 108 values less 6: 7 %, five times


def flips(board, lens, T, with_depth, bias=None, seeds=40):
    """How often the tilt comes out with the wrong sign."""
    wrong = 0
    for seed in range(seeds):
        view = view_of(board, lens, T, np.random.default_rng(seed), 0.3)
        view = view if with_depth else without_depth(view)
        found = pose_view(view, board, lens, bias).T_color_face
        wrong += int(so3.angle_rad(found[:3, :3].T @ T[:3, :3]) > abs(np.arcsin(T[0, 2])))
    return wrong


def test_depth_breaks_the_planar_flip():
    """A board of 12 cm at 3 m, tilted by 25 degrees: its ends differ by 5 cm in depth, eight times the noise, but the two
    tilts move a corner by 2 * 23 px * 0.025 m / 3 m = 0.4 px at most, and the noise is 0.3 px."""
    T = tilted(SMALL, np.radians(25), 3.0)
    assert flips(SMALL, FAR, T, with_depth=False) > 0  # negative control
    assert flips(SMALL, FAR, T, with_depth=True) == 0


def test_a_biased_depth_breaks_it_too():
    """An offset of 5 cm does not matter, since only slopes are compared."""
    T = tilted(SMALL, np.radians(25), 3.0)
    bias = DepthBias((0.05,), 0.5, 4.0, 0.0)
    assert flips(SMALL, FAR, T, True, bias) == 0


def test_pixels_decide_where_they_can():
    """Close by, the pixels know; depth that tells the opposite slope is not asked."""
    T = tilted(BOARD, np.radians(25), 1.0)
    view = view_of(BOARD, FAR, T, np.random.default_rng(0))
    other_way = 2 * np.mean(view.depth_m) - view.depth_m
    found = pose_view(replace(view, depth_m=other_way), BOARD, FAR, None)
    assert so3.angle_rad(found.T_color_face[:3, :3].T @ T[:3, :3]) < np.radians(1)


def test_the_depth_is_asked_up_to_the_stated_difference_of_the_squares():
    """Depth of the opposite slope turns the pose just above the difference that the pixels make, not just below it."""
    T = tilted(BOARD, np.radians(25), 2.0)
    view = view_of(BOARD, FAR, T, np.random.default_rng(0))
    other_way = replace(view, depth_m=2 * np.mean(view.depth_m) - view.depth_m)
    rays = camera.rays(FAR.vector, view.corners_px)
    _, rms = resection.homography_pose(BOARD.corners_m()[view.ids][:, :2], rays)
    difference = 2 * len(view.ids) * ((rms[1] / rms[0]) ** 2 - 1)
    for share, turned in ((0.999, False), (1.001, True)):
        found = pose_view(other_way, BOARD, FAR, None, BoardPoseParams(share * difference)).T_color_face
        assert (so3.angle_rad(found[:3, :3].T @ T[:3, :3]) > np.radians(25)) == turned


def test_a_part_of_the_board_is_enough():
    T = tilted(BOARD, 0.4, 1.5)
    view = view_of(BOARD, FAR, T, np.random.default_rng(1))
    some = np.array([0, 3, 8, 20, 33, 45, 50, 53])
    part = BoardView("C1", "0", some, view.corners_px[some], view.depth_m[some], view.depth_pixels[some])
    found = pose_view(part, BOARD, FAR, None).T_color_face
    # 0.1 px of 575 at 1.5 m over half a metre: 0.05 degrees sideways, a few times that in tilt
    assert so3.angle_rad(found[:3, :3].T @ T[:3, :3]) < np.radians(1)
    assert np.linalg.norm(found[:3, 3] - T[:3, 3]) < 0.01


@pytest.mark.parametrize(("ids", "what"), [([0, 1, 2], "3 points, 4 needed"), ([0, 1, 2, 3, 4, 5], "collinear")])
def test_a_view_that_has_no_pose_is_named(ids, what):
    view = view_of(BOARD, FAR, tilted(BOARD, 0.2, 1.0), np.random.default_rng(0))
    part = BoardView("C1", "000004", np.array(ids), view.corners_px[ids], view.depth_m[ids], view.depth_pixels[ids])
    with pytest.raises(CalibrationError, match=rf"^C1: frame 000004: homography pose: .*{what}"):
        pose_view(part, BOARD, FAR, None)


def test_a_corner_without_a_ray_is_named():
    lens = Intrinsics(640, 480, 575.0, 575.0, 319.5, 239.5, (-0.9, 0.0, 0.0, 0.0, 0.0))  # folds back at 0.61
    view = view_of(BOARD, FAR, tilted(BOARD, 0.2, 1.0), np.random.default_rng(0))
    far_out = view.corners_px.copy()
    far_out[0] = [0.0, 0.0]
    with pytest.raises(CalibrationError, match=r"^C1: frame 000004: .* no ray at \(0, 0\) px"):
        pose_view(replace(view, corners_px=far_out), BOARD, lens, None)

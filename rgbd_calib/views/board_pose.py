"""The pose of the board in one view, from its pixels; measured depth breaks the planar ambiguity.

A plane seen with weak perspective has two poses that fit the pixels almost equally well (the board tilted one way, or
the other). Where their errors do not decide, the slope of the measured depth does: it has opposite signs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import camera, resection, se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, BoardView, DepthBias, PlacedView, PosedView


@dataclass(frozen=True)
class BoardPoseParams:
    min_chi2_difference: float = 30.0
    """Pixels decide between the two poses where their sums of squares differ by more, in units of the better one's
    variance: 30 is 5.5 standard errors."""


SHAPE_STEPS = 4
"""From the pose of a flat print to that of a real one: a fraction of a degree."""


def pose_view(
    view: BoardView, board: Board, intrinsics: Intrinsics, bias: DepthBias | None, params: BoardPoseParams | None = None
) -> PosedView:
    """The face's pose in the colour camera of the view.

    Raises
    ------
    CalibrationError
        Corners too few or on a line, or where the lens model has no ray.
    """
    params = params or BoardPoseParams()
    corners_m = board.corners_m()[view.ids]
    rays = intrinsics.rays(view.corners_px)
    if not (inside := np.isfinite(rays).all(axis=1)).all():
        u, v = view.corners_px[~inside][0]
        raise CalibrationError(
            f"{view.camera}: frame {view.frame}: lens parameters that cover the corners expected, the lens model has no ray at "
            f"({u:.0f}, {v:.0f}) px. Film the board in the corners of this camera's images for its intrinsics, or leave the frame out"
        )
    try:
        poses, rms = resection.homography_pose(corners_m[:, :2], rays)
    except CalibrationError as error:
        raise CalibrationError(f"{view.camera}: frame {view.frame}: {error}") from None
    best = 0
    if len(poses) > 1:
        n = 2 * len(view.ids)
        undecided = n * ((rms[1] / max(rms[0], 1e-9)) ** 2 - 1) < params.min_chi2_difference
        has_depth = np.isfinite(view.depth_m).sum() >= 6
        if undecided and has_depth:
            best = int(np.argmin([_depth_misfit(T, corners_m, view.depth_m, bias) for T in poses]))
    T = poses[best]
    residual = intrinsics.project(se3.transform(T, corners_m)) - view.corners_px
    return PosedView(view, T, float(np.sqrt(np.mean(residual**2))))


def repose(placed: PlacedView, board: Board, intrinsics: Intrinsics) -> PlacedView:
    """The same view, its board posed by its pixels with the corners where the board's shape has them, by Gauss and Newton.

    A homography takes a flat print; which sheet's shape it is, is known of a placed view only. A board of no known shape stays.
    """
    if board.shape is None:
        return placed
    corners_m, T = placed.points_m(board), placed.T_color_board
    for _ in range(SHAPE_STEPS):
        p = se3.transform(T, corners_m)
        pixels, by_point, _ = camera.project_jacobian(intrinsics.vector, p, intrinsics.model)
        J, left = (by_point @ se3.by_motion(p)).reshape(-1, 6), (placed.view.corners_px - pixels).ravel()
        T = se3.retract(T, np.asarray(np.linalg.lstsq(J, left, rcond=None)[0]))
    return replace(placed, T_color_board=T) if np.isfinite(T).all() else placed


def _depth_misfit(
    T_color_face: FloatArray, corners_m: FloatArray, depth_m: FloatArray, bias: DepthBias | None
) -> float:
    """Spread of measured against predicted inverse depth, robust; a common offset does not count."""
    z = se3.transform(T_color_face, corners_m)[:, 2]
    measured = depth_m if bias is None else bias.correct(depth_m)
    difference = (1 / measured - 1 / z)[np.isfinite(depth_m)]
    return float(np.median(np.abs(difference - np.median(difference))))

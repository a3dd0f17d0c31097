"""The board's pose in one view with its information, by pixels and depth together, lens and depth bias as they are.

With X the corners on the board and p = T_color_board X, as in the joint bundle:

    r_pixel = (psi(p) - q) / sigma_2d          r_depth = ([p]_z - z_corrected) / (k z^2)

Depth is off smoothly over a board, not corner by corner: what a plane explains of r_depth has `ratio_depth` times the
deviation of the rest. T_color_board <- Exp(xi) T_color_board, xi = (rad, m) in the camera's frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry import camera, se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.depth_sensor import DepthSensor
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, PlacedView
from rgbd_calib.views.corner_points import corner_points

_ITERATIONS = 8
_HUBER = 3.0
_MIN_DEPTHS = 6


@dataclass(frozen=True)
class ObservationNoise:
    """Deviations of one camera's observations."""

    sigma_2d_px: float = 0.2
    k_depth_per_m: float = 0.002
    """sigma_z = k z^2 of a corner's depth, off the plane part."""
    ratio_pixel: float = 1.5
    """Errors that all corners of a view share, over those of single corners: blur, lens, a board that is not flat."""
    ratio_depth: float = 4.0


@dataclass(frozen=True)
class FittedView:
    """The pose and how well it is known."""

    placed: PlacedView
    T_color_board: FloatArray
    """(4, 4)."""
    information: FloatArray
    """(6, 6), inverse covariance of the left perturbation (rad, m) in the camera's frame."""
    sigma_2d_px: float
    """What the pixels' own residuals say."""
    k_depth_per_m: float
    """What the depth's residuals off their plane say; NaN without depth."""
    plane_sigmas: float
    """Length of the depth's plane part against the pose, in deviations of single corners; NaN without depth."""
    points_m: FloatArray
    """(n, 3), the corners seen, in the board's frame."""


def fit_view(
    placed: PlacedView, board: Board, intrinsics: Intrinsics, sensor: DepthSensor, noise: ObservationNoise
) -> FittedView:
    """Fit the board's pose from the view's start by Gauss-Newton with Huber's weights."""
    view, points = placed.view, placed.points_m(board)
    raw = np.where(np.isfinite(view.depth_m), view.depth_m, 1.0)
    z_m = corner_points(view, placed.T_color_board, intrinsics, sensor)[:, 2]
    has = np.isfinite(z_m)
    z_m = np.where(has, z_m, 1.0)
    has = has if has.sum() >= _MIN_DEPTHS else np.zeros_like(has)
    Q = _plane_part(points, raw, has)
    T = placed.T_color_board
    for _ in range(_ITERATIONS):
        p = se3.transform(T, points)
        pixels, d_point, _ = camera.project_jacobian(intrinsics.vector, p, intrinsics.model)
        d_pose = se3.by_motion(p)
        r2 = (pixels - view.corners_px) / noise.sigma_2d_px
        J2 = np.einsum("nij,njk->nik", d_point, d_pose) / noise.sigma_2d_px
        sigma_z = noise.k_depth_per_m * raw**2
        r3, J3 = has * (p[:, 2] - z_m) / sigma_z, (has / sigma_z)[:, None] * d_pose[:, 2]
        w2 = np.sqrt(_huber(np.linalg.norm(r2, axis=1) / np.sqrt(2)))
        w3 = np.sqrt(_huber(r3 - Q @ (Q.T @ r3)))
        J2, r2 = (J2 * w2[:, None, None]).reshape(-1, 6), (r2 * w2[:, None]).ravel()
        J3, r3 = J3 * w3[:, None], r3 * w3
        QJ, Qr, shrink = Q.T @ J3, Q.T @ r3, 1 - 1 / noise.ratio_depth**2
        information = J2.T @ J2 / noise.ratio_pixel**2 + J3.T @ J3 - shrink * QJ.T @ QJ
        gradient = J2.T @ r2 / noise.ratio_pixel**2 + J3.T @ r3 - shrink * QJ.T @ Qr
        step = -np.linalg.solve(information, gradient)
        T = se3.retract(T, step)
        if step @ information @ step < 1e-8:
            break
    off = r3 - Q @ (Q.T @ r3)
    sigma_2d = noise.sigma_2d_px * np.sqrt(np.sum(r2**2) / max(len(r2) - 6, 1))
    k = noise.k_depth_per_m * np.sqrt(np.sum(off**2) / max(has.sum() - 3, 1)) if has.any() else np.nan
    plane = float(np.linalg.norm(Q.T @ r3)) * noise.k_depth_per_m / k if has.any() else np.nan
    return FittedView(placed, T, information, float(sigma_2d), float(k), plane, points)


def _plane_part(points_m: FloatArray, z_m: FloatArray, has: np.ndarray) -> FloatArray:
    """Orthonormal columns (n, 3): what shifting and tilting the board does to depth over z^2."""
    A = np.column_stack([np.ones(len(z_m)), points_m[:, 0], points_m[:, 1]]) * (has / z_m**2)[:, None]
    if not has.any():
        return np.zeros((len(z_m), 3))
    U, s, _ = np.linalg.svd(A / np.maximum(np.linalg.norm(A, axis=0), 1e-12), full_matrices=False)
    Q: FloatArray = U * (s > 1e-6 * s[0])
    return Q


def _huber(r_sigma: FloatArray) -> FloatArray:
    weights: FloatArray = np.minimum(1.0, _HUBER / np.maximum(np.abs(r_sigma), 1e-12))
    return weights

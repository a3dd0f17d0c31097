"""Views of the board as a detector would give them, without images: true corners with noise, for studies and tests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.depth_sensor import biased
from rgbd_calib.simulation.poses import looks_at_back
from rgbd_calib.types import Board, BoardView, DepthSensor, Rig, RigCamera

_ROUNDS = 6
"""Fixed-point iterations; each reduces the error, at most 30 mm, to 3 %."""
_MIN_COS = 0.25
"""A board seen at more than 75 degrees from its normal is not found."""


@dataclass(frozen=True)
class ViewNoise:
    """Noise of a view's corners."""

    sigma_2d_px: float = 0.1
    k_depth_per_m: float = 0.7e-3
    """Depth of each corner, k z^2: the mean over a corner's cell of a sensor with 1.6e-3."""
    k_plane_per_m: float = 0.3e-3
    """An offset and two tilts of the whole board's depth, each k z^2 at the board's edge: three times what the corners'
    own noise makes of them on a board of 54."""
    spread: float = 0.0
    """Relative variation of sigma_2d_px between views."""


def true_views(
    truth: Rig, boards: Mapping[str, FloatArray], board: Board, noise: ViewNoise, rng: np.random.Generator
) -> tuple[BoardView, ...]:
    """Every camera's view of every board pose, T_world_board (4, 4) by frame, that shows the whole board."""
    out = []
    for frame, T_world_board in boards.items():
        for name, own in truth.cameras.items():
            T_color_board = se3.inverse(own.T_world_color) @ T_world_board
            if not may_be_found(own, T_color_board, board):
                continue
            p = se3.transform(T_color_board, board.corners_m(bool(looks_at_back(T_color_board, board))))
            px = own.intrinsics.project(p)
            z_m = depth_of_board(own, px, p, T_color_board[:3, 2], board, noise, rng)
            sigma_px = noise.sigma_2d_px * (np.exp(rng.normal(0, noise.spread)) if noise.spread else 1.0)
            found = px + rng.normal(0, sigma_px, px.shape)
            out.append(BoardView(name, frame, np.arange(len(px)), found, z_m, np.full(len(px), 30)))
    return tuple(out)


def may_be_found(own: RigCamera, T_color_board: FloatArray, board: Board) -> bool:
    """Does this camera see the whole board, T_color_board (4, 4), square enough?"""
    back = bool(looks_at_back(T_color_board, board))
    p = se3.transform(T_color_board, board.corners_m(back))
    middle = p.mean(axis=0)
    cos = abs(T_color_board[:3, 2] @ middle) / np.linalg.norm(middle)
    if (back and not board.two_sided) or p[:, 2].min() < 0.3 or cos < _MIN_COS:
        return False
    with np.errstate(all="ignore"):
        px = own.intrinsics.project(p)
    lens = own.intrinsics
    inside = np.all((px > 5) & (px < np.array([lens.width, lens.height]) - 6))
    # far outside the image the lens model folds back
    return bool(inside and np.abs(p[:, :2] / p[:, 2:]).max() <= lens.width / lens.fx)


def depth_of_board(
    own: RigCamera,
    px: FloatArray,
    p: FloatArray,
    normal: FloatArray,
    board: Board,
    noise: ViewNoise,
    rng: np.random.Generator,
) -> FloatArray:
    """Reported depth (n,) at pixels (n, 2) that show points (n, 3) of a board with this normal (3,), with noise."""
    z_m = _reported(own, px, p, normal)
    u, v = np.moveaxis(board.corners_m() / np.ptp(board.corners_m(), axis=0).clip(1e-9), 1, 0)[:2] * 2 - 1
    plane = np.stack([np.ones_like(u), u, v], axis=1) @ rng.normal(0, noise.k_plane_per_m, 3)
    return np.asarray(z_m + (plane + rng.normal(0, noise.k_depth_per_m, len(z_m))) * z_m**2)


def _reported(own: RigCamera, pixels_px: FloatArray, p_color: FloatArray, normal: FloatArray) -> FloatArray:
    """Reported depth (n,) at the pixels (n, 2) of corners (n, 3) of a board with this normal (3,).

    A misregistered depth image shows another point there: the intersection of the depth camera's ray with the board's plane.
    """
    sensor = own.depth_sensor
    if own.depth_camera is None and own.depth_field is None:
        return p_color[:, 2] if own.depth_bias is None else biased(p_color[:, 2], own.depth_bias)
    if own.depth_camera is None:
        return sensor_reports(sensor, pixels_px, p_color[:, 2])
    T_depth_color = se3.inverse(own.depth_camera.T_color_depth)
    p, n = se3.transform(T_depth_color, p_color), T_depth_color[:3, :3] @ normal
    z_m = (p @ n) / (sensor.camera.intrinsics.rays(pixels_px) @ n)
    return sensor_reports(sensor, pixels_px, z_m)


def sensor_reports(sensor: DepthSensor, pixels_px: FloatArray, z_true_m: FloatArray) -> FloatArray:
    """Reported depths (n,), metres, at pixels (n, 2) of the depth image, for true depths (n,)."""
    z_m = np.array(z_true_m, float)
    for _ in range(_ROUNDS):
        z_m = z_m - (sensor.correct(pixels_px, z_m) - z_true_m)
    return z_m


def near_poses(
    boards: Mapping[str, FloatArray], board: Board, n: int, rng: np.random.Generator
) -> dict[str, FloatArray]:
    """`n` board poses near some of `boards`: each carried by up to 10 cm and turned by up to 12 degrees."""
    names = sorted(boards)
    middle = se3.make(np.eye(3), board.corners_m().mean(axis=0))
    out = {}
    for i, k in enumerate(rng.choice(len(names), n, replace=n > len(names))):
        step = np.concatenate([rng.uniform(-0.2, 0.2, 3), rng.uniform(-0.1, 0.1, 3)])
        out[f"{i:06d}"] = boards[names[k]] @ middle @ se3.retract(np.eye(4), step) @ se3.inverse(middle)
    return out

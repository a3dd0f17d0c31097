"""The board as a thing in the scene: print on one face or both, on a stand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.patterns.black import rim_m
from rgbd_calib.simulation.scene import Scene, box, join, quad, rod
from rgbd_calib.simulation.textures import Material, hex_color, plain
from rgbd_calib.types import Board

BORDER_M = 0.030
"""White paper around the print: half a square of the default board, which OpenCV's finders need."""
_INK, _PAPER = hex_color("262626"), hex_color("dadad6")
_CORE = plain("board core", "d8d4c8")
_STEEL = plain("steel", "8c9096")
_STAND_RADIUS_M = 0.011


def first_m(board: Board) -> float:
    """From the plate's edges to corner (0, 0) of a face."""
    return rim_m(board) + BORDER_M


def sides_m(board: Board) -> FloatArray:
    """Width and height (2,) of the print."""
    return board.grid[-1] * board.square_m + 2 * rim_m(board)


def outline_m(board: Board) -> tuple[FloatArray, FloatArray]:
    """Opposite corners (3,), (3,) of the plate, metres, in the board's frame."""
    low = np.array([-first_m(board), -first_m(board), 0.0])
    return low, low + [*sides_m(board) + 2 * BORDER_M, max(board.thickness_m, 0.001)]


def plate(board: Board) -> Scene:
    """The board in its own frame."""
    low, high = outline_m(board)
    print_ = Material("print", "print", (_INK, _PAPER), first_m(board), board=replace(board, shape=None))
    x, y, z = np.diag(high - low)
    back = quad(low + z + x, -x, y, print_ if board.two_sided else _CORE)
    sides = [quad(c, u, z, _CORE) for c, u in ((low, x), (low + y, x), (low, y), (low + x, y))]
    return join([quad(low, x, y, print_), back, *sides])


def grid_m(board: Board, n: int = 7) -> FloatArray:
    """Points (n * n, 3) spread over the plate, its rim included, metres, in the board's frame."""
    low, high = outline_m(board)
    x, y = np.meshgrid(np.linspace(low[0], high[0], n), np.linspace(low[1], high[1], n))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, (low[2] + high[2]) / 2)], axis=1)


def stand_foot_m(board: Board, T_room_board: FloatArray) -> FloatArray:
    """Where the stand holds the board, (3,), metres, in the room: the middle of its lowest edge."""
    low, high = outline_m(board)
    mid, z = (low + high) / 2, (low[2] + high[2]) / 2
    middles = np.array([[mid[0], low[1], z], [mid[0], high[1], z], [low[0], mid[1], z], [high[0], mid[1], z]])
    in_room = se3.transform(T_room_board, middles)
    return in_room[np.argmin(in_room[:, 2])]


def on_stand(board: Board, T_room_board: FloatArray, ground_z_m: float) -> Scene:
    """The board at its pose, a pole from its lowest edge straight down to height `ground_z_m`, and a foot plate."""
    top = stand_foot_m(board, T_room_board)
    parts = [plate(board).moved(T_room_board)]
    if top[2] - ground_z_m > 0.03:
        foot = np.array([top[0], top[1], ground_z_m])
        parts.append(rod(foot, top - [0, 0, _STAND_RADIUS_M], _STAND_RADIUS_M, _STEEL))
        parts.append(box(foot - [0.09, 0.09, 0], foot + [0.09, 0.09, 0.012], _STEEL))
    return join(parts)

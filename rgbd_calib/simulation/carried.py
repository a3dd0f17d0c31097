"""Images of a board that moves while they are exposed: motion blur, and rows of a rolling shutter one after the other."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation import board as boards
from rgbd_calib.simulation.bent import bent_faces
from rgbd_calib.simulation.clocks import CameraClock
from rgbd_calib.simulation.motion import HandMotion
from rgbd_calib.simulation.printed import Printed
from rgbd_calib.simulation.render import IdealImage, render_with_board
from rgbd_calib.simulation.scene import Caster
from rgbd_calib.simulation.surfaces import see_board, with_board
from rgbd_calib.simulation.view import View
from rgbd_calib.types import Board

BLUR_SAMPLES = 3
"""Instants that an exposure is the mean of: half a pixel apart where the board is sharp enough to be found."""
BAND_ROWS = 16
"""Rows of a rolling shutter that are exposed as one: 20 ms over 480 rows and 0.5 m/s make steps of 0.1 px, half of it off a corner at most."""
_ROUNDS = 4


@dataclass(frozen=True)
class BoardExposure:
    """The motion of the board about one exposure."""

    motion: HandMotion
    T_room_parent: FloatArray
    """(4, 4), of the frame that the motion is in."""
    t_s: float
    """Of the middle row."""
    clock: CameraClock
    exposure_s: float

    def pose(self, after_s: float = 0.0) -> FloatArray:
        """T_room_board (4, 4), so long after the middle row's instant."""
        return np.asarray(self.T_room_parent @ self.motion.poses(np.array([self.t_s + after_s]))[0])

    @property
    def depth_pose(self) -> FloatArray:
        """T_room_board (4, 4) at the instant of the depth image."""
        return self.pose(self.clock.depth_delay_s)

    def row_delay_s(self, row: float, height: int) -> float:
        return self.clock.readout_s * ((row + 0.5) / height - 0.5)

    def points(self, K: Intrinsics, T_room_color: FloatArray, corners_m: FloatArray) -> FloatArray:
        """Corners (n, 3), metres, in the camera's frame, each at the instant of the row that shows it."""
        T_color_room, p = se3.inverse(T_room_color), np.zeros_like(corners_m)
        delay = np.zeros(len(corners_m))
        for _ in range(_ROUNDS if self.clock.readout_s else 1):
            T = T_color_room @ self.T_room_parent @ self.motion.poses(self.t_s + delay)
            p = se3.transform(T, corners_m)
            if np.any(p[:, 2] < 0.1):
                return p
            delay = self.clock.readout_s * ((K.project(p)[:, 1] + 0.5) / K.height - 0.5)
        return p


def render_carried(
    carried: BoardExposure,
    K: Intrinsics,
    T_room_color: FloatArray,
    room: IdealImage,
    room_caster: Caster,
    board: Board,
    made: Printed | None,
    rng: np.random.Generator,
) -> IdealImage:
    """What the camera sees over the exposure; depth and cosines are those of the middle row's instant."""
    rows = BAND_ROWS if carried.clock.readout_s else K.height
    light = room.light.copy()
    ends = [carried.pose(carried.row_delay_s(row, K.height)) for row in (0, K.height / 2, K.height)]
    low, high = _reach(K, T_room_color, board, ends)
    for first in range(0, K.height, rows):
        last = min(first + rows, K.height)
        if last < low or first > high:
            continue
        view, above = _band(K, _key(T_room_color), first, last)
        part = slice(first - above, last + min(1, K.height - last))
        own = IdealImage(room.light[part], room.z_m[part], room.cos_incidence[part])
        delay = carried.row_delay_s((first + last - 1) / 2, K.height)
        total = np.zeros_like(own.light)
        for k in range(BLUR_SAMPLES):
            T = carried.pose(delay + carried.exposure_s * ((k + 0.5) / BLUR_SAMPLES - 0.5))
            caster = Caster(boards.plate(board).moved(T))
            bent = bent_faces(made, T, view.origin_m)
            total += render_with_board(view, own, room_caster, caster, rng, bent).light
        light[first:last] = total[above : above + last - first] / BLUR_SAMPLES
    return replace(_geometry(carried.pose(), View(K, T_room_color), room, board, made), light=light)


def depth_picture(
    carried: BoardExposure, view: View, room: IdealImage, board: Board, made: Printed | None
) -> tuple[IdealImage, Caster]:
    """Depth and cosines at the depth image's instant, registered to colour, and the board there."""
    T = carried.depth_pose
    return _geometry(T, view, room, board, made), Caster(boards.plate(board).moved(T))


def _geometry(T: FloatArray, view: View, room: IdealImage, board: Board, made: Printed | None) -> IdealImage:
    caster = Caster(boards.plate(board).moved(T))
    seen = see_board(view, room.z_m, caster, bent_faces(made, T, view.origin_m))
    return IdealImage(room.light, *with_board(room.z_m, room.cos_incidence, seen))


def _reach(K: Intrinsics, T_room_color: FloatArray, board: Board, poses: list[FloatArray]) -> tuple[float, float]:
    """Rows that the board touches."""
    T_color_room = se3.inverse(T_room_color)
    p = np.concatenate([se3.transform(T_color_room @ T, boards.grid_m(board)) for T in poses])
    if p[:, 2].min() < 0.1:
        return 0.0, float(K.height)
    v = K.project(p)[:, 1]
    return float(v.min()) - 10, float(v.max()) + 10


def _key(T: FloatArray) -> tuple[float, ...]:
    return tuple(T.ravel().tolist())


@lru_cache(maxsize=512)
def _band(K: Intrinsics, key: tuple[float, ...], first: int, last: int) -> tuple[View, int]:
    """The camera with some of its rows alone, one more on each side where there is one; and whether there is one above."""
    above, below = min(1, first), min(1, K.height - last)
    rows = last + below - (first - above)
    return View(replace(K, height=rows, cy=K.cy - (first - above)), np.array(key).reshape(4, 4)), above

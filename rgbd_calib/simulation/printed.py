"""A board as printers and hands make it: sheets that are not square, glued to a plate that is not flat.

A point x of the page as designed (in the frame of the face: columns, rows) is printed at

    face(x) = m + A (x - m) + offset(x) + shift        A = scale S(aspect, shear) rotation,   m the centre of the page

and the plate displaces it by bow(x, y) along its normal. S is symmetric and preserves area. The offsets are smooth: uneven paper
feed with the circumferences of the drive rollers as periods, nonlinearity along the scan line (f-theta error of a laser, stretch of
a carriage belt), and strain from gluing.

Both faces are prints of one page by one printer and share A except for the rotation; seen from the front, the shear of the back has
the opposite sign. The board frame is the rigid motion that brings the front corners closest to their nominal positions.

References
----------
K. Strobl, G. Hirzinger, More accurate pinhole camera calibration with imperfect planar target, ICCV workshops 2011.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rgbd_calib.geometry import align, se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.board import sides_m
from rgbd_calib.simulation.realism import Realism
from rgbd_calib.types import Board, BoardShape

_ROLLERS_M = (0.35, 1.1)
"""Range of the periods along the feed, in heights of the print."""
_GLUE_WAVES, _ROLLERS = 3, 2


@dataclass(frozen=True)
class Waves:
    """A smooth vector field on the page: sum_k amplitude_k sin(2 pi wave_k x + phase_k)."""

    amplitude_m: FloatArray
    """(k, 2)."""
    per_m: FloatArray
    """(k, 2)."""
    phase_rad: FloatArray
    """(k,)."""

    def at(self, page_m: FloatArray) -> FloatArray:
        """Offsets (..., 2), metres, at points (..., 2)."""
        angle = 2 * np.pi * page_m @ self.per_m.T + self.phase_rad
        return np.asarray(np.sin(angle) @ self.amplitude_m)


@dataclass(frozen=True)
class Plate:
    """The plate: displacement ``bow cos(2 pi along.x) + twist sin(..) sin(..)`` along its normal, x from its centre."""

    middle_m: FloatArray
    """(2,), in the board's frame."""
    bow_m: float
    along: FloatArray
    """(2,): wave vector of the bow, cycles per metre; half a cycle from edge to edge."""
    twist_m: float
    sides_m: FloatArray
    """(2,): width and height of the print."""

    def lift_m(self, xy_m: FloatArray) -> FloatArray:
        """Displacement (...) along z at points (..., 2) of the board's frame, metres."""
        x = xy_m - self.middle_m
        twist = np.prod(np.sin(np.pi * x / (1.2 * self.sides_m)), axis=-1)
        return np.asarray(self.bow_m * np.cos(2 * np.pi * x @ self.along) + self.twist_m * twist)


@dataclass(frozen=True)
class PrintedFace:
    """The print on one face; page coordinates are in the face's own frame, metres."""

    board: Board
    """Nominal board."""
    back: bool
    linear: FloatArray
    """(2, 2): A."""
    shift_m: FloatArray
    """(2,)."""
    waves: Waves
    plate: Plate
    T_board_made: FloatArray
    """(4, 4), a small motion into the board's frame."""

    def points_m(self, page_m: FloatArray) -> FloatArray:
        """Points (..., 3), metres, in the board's frame, of page coordinates (..., 2)."""
        middle = _middle(self.board)
        face = middle + (page_m - middle) @ self.linear.T + self.shift_m + self.waves.at(page_m)
        xy = face * [-1, 1] + [2 * middle[0], 0] if self.back else face
        z = self.plate.lift_m(xy) + (self.board.thickness_m if self.back else 0.0)
        return se3.transform(self.T_board_made, np.concatenate([xy, z[..., None]], axis=-1))

    def corners_m(self) -> FloatArray:
        """Corners (n, 3) of the face in its own order, in the board's frame, metres."""
        return self.points_m(_corners(self.board))


@dataclass(frozen=True)
class Printed:
    """Both faces of a board."""

    front: PrintedFace
    back: PrintedFace | None

    @property
    def board(self) -> Board:
        """The board with its true shape."""
        stated = self.front.board
        r, c = np.divmod(np.arange(stated.n_corners), stated.cols)
        behind = None if self.back is None else self.back.corners_m()[r * stated.cols + stated.cols - 1 - c]
        return replace(stated, shape=BoardShape(self.front.corners_m(), behind))


def printed(board: Board, realism: Realism, rng: np.random.Generator) -> Printed:
    """Draw the errors of a board."""
    aspect, shear = rng.normal(0, [realism.print_aspect, realism.print_shear_rad])
    scale = 1 + rng.normal(0, realism.print_scale)
    A = scale * np.array([[np.exp(aspect / 2), shear / 2], [shear / 2, np.exp(-aspect / 2)]])
    A /= np.sqrt(np.linalg.det(A)) / scale
    plate = _plate(board, realism.plate_bow_m, rng)
    sheets = []
    for back in (False, True) if board.two_sided else (False,):
        turn = rng.normal(0, realism.back_turn_rad) * back
        shift = rng.normal(0, realism.back_shift_m, 2) * back
        waves, straight = _waves(board, realism.print_offset_m, rng)
        R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        # remove the affine part of the offsets, so that aspect and shear are as drawn
        linear, moved = R @ A - straight[:2].T, shift - straight[2]
        sheets.append(PrintedFace(board, back, linear, moved, waves, plate, np.eye(4)))
    T_board_made = align.rigid(board.corners_m(), sheets[0].corners_m())
    made = [replace(sheet, T_board_made=T_board_made) for sheet in sheets]
    return Printed(made[0], made[1] if board.two_sided else None)


def _plate(board: Board, bow_m: float, rng: np.random.Generator) -> Plate:
    sides = sides_m(board)
    bow, twist, way = rng.normal(0, bow_m), rng.normal(0, 0.4 * bow_m), rng.uniform(0, np.pi)
    direction = np.array([np.cos(way), np.sin(way)])
    across = np.abs(direction) @ sides
    return Plate(_middle(board), bow, direction / (2 * across), twist, sides)


def _waves(board: Board, rms_m: float, rng: np.random.Generator) -> tuple[Waves, FloatArray]:
    """Offsets with this RMS per coordinate at the corners, affine part excluded; and that part, (3, 2) for x - m, y - m, 1."""
    width, height = sides_m(board)
    feed = [(0.0, 1 / (height * rng.uniform(*_ROLLERS_M))) for _ in range(_ROLLERS)]
    lines = [(1 / (width * rng.uniform(0.8, 1.2)), 0.0)]
    angles, lengths = rng.uniform(0, 2 * np.pi, _GLUE_WAVES), width * rng.uniform(0.4, 1.2, _GLUE_WAVES)
    glue = np.stack([np.cos(angles), np.sin(angles)], axis=1) / lengths[:, None]
    pulls = rng.normal(0, 0.7, (_GLUE_WAVES, 2))
    along_feed = np.stack([np.zeros(_ROLLERS), rng.normal(0, 1, _ROLLERS)], axis=1)
    along_line = np.array([[rng.choice([-1.0, 1.0]) * rng.uniform(0.8, 1.4), 0.0]])
    amplitude = np.concatenate([along_feed, along_line, pulls])
    phase = rng.uniform(0, 2 * np.pi, len(amplitude))
    waves = Waves(amplitude, np.concatenate([feed, lines, glue]), phase)
    page = _corners(board)
    V = np.column_stack([page - _middle(board), np.ones(len(page))])
    offsets = waves.at(page)
    straight = np.linalg.lstsq(V, offsets, rcond=None)[0]
    scale = rms_m / np.sqrt(np.mean((offsets - V @ straight) ** 2))
    return replace(waves, amplitude_m=scale * amplitude), scale * straight


def _middle(board: Board) -> FloatArray:
    return np.asarray(board.grid[-1] * board.square_m / 2)


def _corners(board: Board) -> FloatArray:
    """Nominal corners (n, 2) of the page."""
    return np.asarray(replace(board, shape=None).corners_m()[:, :2])

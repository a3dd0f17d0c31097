"""What is black on a board, as rectangles and as a lattice of cells; metres from corner (0, 0)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.patterns import aprilgrid, charuco
from rgbd_calib.types import Board

_SAME_M = 1e-7
"""Lines of the print that are nearer than this are one: markers are given in single precision."""


def rim_m(board: Board) -> float:
    """What is black beyond the outer corners: squares, the small ones of an AprilGrid."""
    return aprilgrid.gap_m(board) if board.type == "aprilgrid" else board.square_m


def cell_m(board: Board) -> float:
    """Side of the cells that its markers are made of."""
    _, cells = next(_codes(board))
    return board.marker_m / len(cells)


def _codes(board: Board) -> Iterator[tuple[FloatArray, np.ndarray]]:
    """Top left corner, from corner (0, 0), and cells (n, n), True = white, of each marker."""
    if board.type == "aprilgrid":
        yield from aprilgrid.tags(board)
    elif board.type == "charuco":
        for corner_m, cells in charuco.markers(board):
            yield corner_m[:2] - board.square_m, cells


def rectangles_m(board: Board) -> FloatArray:
    """Left, top, width and height (n, 4) of what is black."""
    rim = rim_m(board)
    tags = board.type == "aprilgrid"
    step = 2 * board.square_m if tags else board.square_m
    j, i = np.indices((board.rows // 2 + 1, board.cols // 2 + 1) if tags else (board.rows + 1, board.cols + 1))
    white = int(board.legacy and board.rows % 2 == 1)  # of an even number of rows of squares
    black = np.full(i.shape, True) if tags else (i + j) % 2 == white
    squares = step * np.stack([i[black], j[black]], axis=1) - rim
    parts = [np.column_stack([squares, np.full_like(squares, rim)])]
    for corner_m, cells in _codes(board):
        side = board.marker_m / len(cells)
        places = corner_m + side * np.argwhere(~cells)[:, ::-1]
        parts.append(np.column_stack([places, np.full_like(places, side)]))
    return np.concatenate(parts)


@dataclass(frozen=True)
class Lattice:
    """The print cut along every line that bounds something black."""

    lines_m: tuple[FloatArray, FloatArray]
    """Ascending, across columns and across rows."""
    black: np.ndarray
    """(columns, rows) bool; the first and last of each are beyond the lines, and white."""

    def cells(self, x_m: FloatArray, y_m: FloatArray) -> tuple[np.ndarray, np.ndarray]:
        """Column and row of the cells at places, any shape; 0 and the last are outside."""
        i, j = (np.searchsorted(own, at, "right") for own, at in zip(self.lines_m, (x_m, y_m), strict=True))
        return i, j

    def is_black(self, x_m: FloatArray, y_m: FloatArray) -> np.ndarray:
        """Bool, of the places' shape."""
        return np.asarray(self.black[self.cells(x_m, y_m)])


@lru_cache(maxsize=8)
def lattice(board: Board) -> Lattice:
    """The cells of a board's print."""
    black = rectangles_m(board)
    ends = np.stack([black[:, :2], black[:, :2] + black[:, 2:]])
    lines_m = tuple(_distinct(ends[..., axis]) for axis in (0, 1))
    inside = np.zeros([len(own) + 1 for own in lines_m], bool)
    low, high = (
        np.stack([np.searchsorted(lines_m[k], end[:, k] - _SAME_M) for k in (0, 1)], axis=1) + 1 for end in ends
    )
    for (i0, j0), (i1, j1) in zip(low, high, strict=True):
        inside[i0:i1, j0:j1] = True
    return Lattice((lines_m[0], lines_m[1]), inside)


def _distinct(values: FloatArray) -> FloatArray:
    ordered = np.unique(values)
    return ordered[np.diff(ordered, prepend=-np.inf) > _SAME_M]

"""What the blocks of the board's shape share: corners of the board's frame move linearly with the parameters."""

from __future__ import annotations

from abc import abstractmethod
from functools import cached_property

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Block, Kind, Scope
from rgbd_calib.rig.sight import Look
from rgbd_calib.types import Board


def nominal_corners_m(board: Board) -> FloatArray:
    """(2, M, 3): corners of the front, and the back's corner behind each, in the front's order, in the board's frame."""
    mirrored = np.arange(board.n_corners).reshape(board.rows, board.cols)[:, ::-1].ravel()
    return np.stack([board.corners_m(), board.corners_m(back=True)[mirrored]])


class BoardShapeBlock(Block):
    """Parameters of the board's shape, (1, n)."""

    scope = Scope.RIG
    kinds = frozenset({Kind.PIXEL, Kind.DEPTH})

    @abstractmethod
    def table(self) -> FloatArray:
        """(2, M, 3, n): how the corners of the front, and those behind them, move with the parameters, in the board's frame."""

    @cached_property
    def _table(self) -> FloatArray:
        return self.table()

    def shift_m(self, value: FloatArray) -> FloatArray:
        """(2, M, 3), metres."""
        return np.asarray(self._table @ value[0])

    def derivative(self, look: Look) -> FloatArray:
        obs = look.sight.obs
        return look.by_point_on_board @ self._table[obs.back[:, None], obs.corner]

    @cached_property
    def over_board(self) -> tuple[FloatArray, FloatArray]:
        """x and y (2, M) of the corners, from -1 to 1 over the board."""
        board = self.setup.board
        places = 2 * nominal_corners_m(board)[..., :2] / (board.grid[-1] * board.square_m) - 1
        return places[..., 0], places[..., 1]

"""A plate that is bent: x^2 - 1/3, x y, y^2 - 1/3 with x, y from -1 to 1 over the board, along its normal."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import BlockPrior
from rgbd_calib.rig.blocks.board_shape import BoardShapeBlock


class BoardBow(BoardShapeBlock):
    """Three heights, metres."""

    name = "bow"

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("bow along the columns", "twist", "bow along the rows")

    def prior(self) -> BlockPrior:
        params = self.setup.params
        free, measured = np.full(3, params.free_bow), np.zeros(3, bool)
        return BlockPrior(np.zeros(3), np.eye(3) / params.bow_sd_m**2, free, measured)

    def table(self) -> FloatArray:
        x, y = self.over_board
        out = np.zeros((*x.shape, 3, 3))
        out[..., 2, :] = np.stack([x * x - 1 / 3, x * y, y * y - 1 / 3], axis=-1)
        return out

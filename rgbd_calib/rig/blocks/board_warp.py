"""A plate that is bent in a shape that the bow does not follow: polynomials of the third and fourth degree along its normal."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.depth_error import n_terms, terms
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Fault
from rgbd_calib.rig.blocks.board_shape import BoardShapeBlock

DEGREE = 4
_OF_BOW = n_terms(2)


class BoardWarp(BoardShapeBlock):
    """Nine heights, metres."""

    name = "warp"
    held = Fault(
        "shape",
        lambda t: f"The board is not flat, by {t.mm} RMS in a shape that the bow does not follow",
        "Glue the print on glass, aluminium or a thick plate",
    )

    @property
    def parameters(self) -> tuple[str, ...]:
        return tuple(f"warp {k}" for k in range(n_terms(DEGREE) - _OF_BOW))

    def table(self) -> FloatArray:
        x, y = self.over_board
        out = np.zeros((*x.shape, 3, self.n))
        out[..., 2, :] = terms(x, y, DEGREE)[..., _OF_BOW:]
        return out

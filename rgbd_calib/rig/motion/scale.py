"""The size of a carried board, as its depth has it.

A board that is larger by a share s, carried s farther about, has the same pixels; all depths are s larger. But the prior of the
motion does not scale with it: the larger motion would cost, which says nothing of the board. So the depths are scaled instead.
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Kind
from rgbd_calib.rig.blocks.board_scale import BoardScale
from rgbd_calib.rig.sight import Look


class CarriedScale(BoardScale):
    """By how much all of it is larger, a share."""

    kinds = frozenset({Kind.DEPTH})

    def derivative(self, look: Look) -> FloatArray:
        assert look.slope is not None  # rows of depth have it
        z = look.depth_m / look.slope + look.left[..., 0]  # as predicted: its error must not be that of the row
        return np.where(look.sight.obs.has_depth, z, 0.0)[..., None, None]

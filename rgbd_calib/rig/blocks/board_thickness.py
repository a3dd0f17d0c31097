"""The thickness of a two-sided board."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Fault
from rgbd_calib.rig.blocks.board_shape import BoardShapeBlock, nominal_corners_m


class BoardThickness(BoardShapeBlock):
    """By how much the back is farther behind the front, metres."""

    name = "thickness"
    held = Fault(
        "thickness",
        lambda t: f"The board's faces are {1e3 * t.estimate[0]:+.1f} mm farther apart than stated",
        "Measure the board's thickness and correct `thickness`",
    )

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("thickness",)

    def table(self) -> FloatArray:
        out = np.zeros((*nominal_corners_m(self.setup.board).shape, 1))
        out[1, :, 2] = 1.0
        return out

    def effect(self, distance_m: float, lateral_m: float) -> FloatArray:
        return np.eye(1)

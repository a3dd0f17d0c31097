"""The back of a two-sided board: a sheet of its own, beside, turned, larger, and farther behind than was meant."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import BlockPrior, Fault
from rgbd_calib.rig.blocks.board_shape import BoardShapeBlock, nominal_corners_m


class BackSheet(BoardShapeBlock):
    """Shift in x and y and along the normal, metres; turn, rad; scale, a share; in the board's frame."""

    name = "back sheet"
    known = Fault(
        "thickness",
        lambda t: (
            f"The back of the board differs from what was stated: {1e3 * t.estimate[2]:+.1f} mm in thickness, its sheet "
            f"{1e3 * t.estimate[0]:+.1f}, {1e3 * t.estimate[1]:+.1f} mm beside the front's and {100 * t.estimate[4]:+.2f} % in size"
        ),
        "Measure the board's thickness and correct `thickness`; check that both faces are the same print",
    )

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("back in x", "back in y", "thickness", "turn of the back", "scale of the back")

    def prior(self) -> BlockPrior:
        own = self.setup.params
        shift = own.back_shift_sd_m
        sd = np.array([shift, shift, own.thickness_sd_m, own.back_turn_sd_rad, own.back_scale_sd])
        free = np.full(5, bool(np.any(self.setup.obs.back)))
        return BlockPrior(np.zeros(5), np.diag(sd**-2.0), free, np.zeros(5, bool))

    def table(self) -> FloatArray:
        corners = nominal_corners_m(self.setup.board)
        middle = corners[0].mean(axis=0)
        x, y = corners[1, :, 0] - middle[0], corners[1, :, 1] - middle[1]
        out = np.zeros((*corners.shape, 5))
        out[1, :, 0, 0] = out[1, :, 1, 1] = out[1, :, 2, 2] = 1.0
        out[1, :, 0, 3], out[1, :, 1, 3] = -y, x
        out[1, :, 0, 4], out[1, :, 1, 4] = x, y
        return out

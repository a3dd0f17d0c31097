"""A print that is out of square: printers scale their two ways differently, and feed paper a little askew.

    X = A (c s, r s)        A = [[1 + a, b], [b, 1 - a]] about the board's middle

to first order: `a` half the difference of the two scales, `b` half the angle by which the axes are from square; the area is
kept, since the size of the squares is the user's. The back of a two-sided board is the same print seen from the other side:
its `a` is the same, its `b` has the opposite sign.
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import BlockPrior, Fault, Told
from rgbd_calib.rig.blocks.board_shape import BoardShapeBlock, nominal_corners_m


def _say(t: Told) -> str:
    narrower = -200 * t.estimate[0]
    return (
        f"The printed squares are not square: {abs(narrower):.2f} % {'narrower' if narrower > 0 else 'wider'} along the columns "
        f"than along the rows, their axes {np.degrees(2 * t.estimate[1]):+.2f} deg from square"
    )


class BoardPrint(BoardShapeBlock):
    """Aspect and shear."""

    name = "print"
    held = Fault(
        "stretch", _say, "The printer scaled its two ways differently. Measure both, and print again without scaling"
    )

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("aspect of the print", "shear of the print")

    def prior(self) -> BlockPrior:
        sd = np.array([self.setup.params.print_aspect_sd, self.setup.params.print_shear_sd_rad]) / 2
        return BlockPrior(np.zeros(2), np.diag(sd**-2.0), np.ones(2, bool), np.zeros(2, bool))

    def table(self) -> FloatArray:
        corners = nominal_corners_m(self.setup.board)
        middle = corners[0].mean(axis=0)
        x, y = corners[..., 0] - middle[0], corners[..., 1] - middle[1]
        out = np.zeros((*x.shape, 3, 2))
        out[..., 0, 0], out[..., 1, 0] = x, -y
        out[..., 0, 1], out[..., 1, 1] = y, x
        out[1, ..., 1] *= -1.0
        return out

    def effect(self, distance_m: float, lateral_m: float) -> FloatArray:
        return distance_m**2 * np.eye(2)

"""The size of the board's squares: the user's word is taken, and the depth says how well it agrees."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Fault, Told
from rgbd_calib.rig.blocks.board_shape import BoardShapeBlock, nominal_corners_m
from rgbd_calib.rig.setup import Setup

LINEAR = 0.25
"""Of the size: the test is linear, and its number says no more beyond."""


def _percent(t: Told) -> str:
    return f"{100 * t.estimate[0]:+.2f} % (\u00b1 {100 * float(np.sqrt(max(t.covariance[0, 0], 0))):.2f} %)"


def _say(t: Told) -> str:
    if abs(t.estimate[0]) > LINEAR:
        way = "larger" if t.estimate[0] > 0 else "smaller"
        return f"The depth says that the board's squares are more than {100 * LINEAR:.0f} % {way} than stated, or that the depth is wrong"
    return (
        f"The depth says that the board's squares are {_percent(t)} from the stated size: all distances are off by {t.mm} at "
        f"{t.distance_m:.1f} m, or the depth is"
    )


class BoardScale(BoardShapeBlock):
    """By how much all of it is larger, a share."""

    name = "scale"
    held = Fault(
        "scale",
        _say,
        "Measure the print with a ruler over as many squares as there are and correct `square`; if it is right, check the "
        "depth's unit and the distances of the bias recording",
    )
    between_recordings = Fault(
        "board between recordings",
        lambda t: (
            f"The board's squares in the intrinsic recording are {_percent(t)} from those in the rig's, or {t.mm} at "
            f"{t.distance_m:.1f} m; or the depth of all cameras drifted by as much"
        ),
        "Were both filmed with one board, with cameras that were warm? Say the squares of each in its dataset.yaml, or film the "
        "intrinsic recording again",
    )
    least_seen = (
        1e-9  # the board's size is not seen in pixels; what is known of the depth before is little against them
    )

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        return bool(setup.obs.has_depth.any())  # pixels alone have no metre

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("scale of the board",)

    def table(self) -> FloatArray:
        return nominal_corners_m(self.setup.board)[..., None]

    def effect(self, distance_m: float, lateral_m: float) -> FloatArray:
        return np.array([[distance_m**2]])

"""Is measured depth of the order of what the pixels say? Units and sizes that were mistaken show here, before any fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import se3
from rgbd_calib.types import Board, DepthBias, PosedView

MAX_RATIO = 1.25
"""Of measured depth over the distance by the pixels, and of its inverse. Depth sensors are good to a few per cent, focal
lengths from views to five at least; the smallest mistake of units (inch for cm) is a factor of 2.5."""
SAME = 1.05
"""Cameras whose ratios differ by less have one reason."""


def depth_over_pixels(posed: PosedView, board: Board, bias: DepthBias | None) -> float | None:
    """Median of measured depth, its bias removed, over the distance of the board by its pixels; None without depth."""
    measured = np.isfinite(posed.view.depth_m)
    if measured.sum() < max(len(measured) // 2, 1):
        return None
    z_m = se3.transform(posed.T_color_face, board.corners_m()[posed.view.ids[measured]])[:, 2]
    depth_m = posed.view.depth_m[measured]
    return float(np.median((depth_m if bias is None else bias.correct(depth_m)) / z_m))


def check_depth_scale(posed: Sequence[PosedView], board: Board, biases: Mapping[str, DepthBias]) -> None:
    """Refuse depth that has nothing to do with the pixels.

    Raises
    ------
    CalibrationError
        The depth of a camera is 25 % off, in the median of its views: names the cameras, and what to look at.
    """
    ratios: dict[str, list[float]] = {}
    for p in posed:
        ratio = depth_over_pixels(p, board, biases.get(p.view.camera))
        if ratio is not None:
            ratios.setdefault(p.view.camera, []).append(ratio)
    usual = {name: float(np.median(own)) for name, own in ratios.items()}
    wrong = {name: r for name, r in usual.items() if not 1 / MAX_RATIO < r < MAX_RATIO}
    if not wrong:
        return
    named = ", ".join(f"{name} {r:.3g}" for name, r in wrong.items())
    low, high = min(usual.values()), max(usual.values())
    if len(wrong) == len(usual) and high < SAME * low:
        todo = (
            f"All cameras agree: measure the board's squares ({1e3 * board.square_m:g} mm stated), and check depth_scale "
            "(metres for each unit of the depth images)"
        )
    else:
        todo = "Check depth_scale of these cameras (metres for each unit of their depth images), and their intrinsics"
    raise CalibrationError(
        f"{', '.join(wrong)}: measured depth over the board's distance by its pixels is {named} in the median of the views; "
        f"{1 / MAX_RATIO:g} to {MAX_RATIO:g} needed. {todo}"
    )

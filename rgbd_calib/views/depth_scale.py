"""Is measured depth of the order of what the pixels say? Units and sizes that were mistaken show here, before any fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, DepthBias, PosedView

MAX_RATIO = 1.25
"""Of measured depth over the distance by the pixels, and of its inverse. Depth sensors are good to a few per cent, focal
lengths from views to five at least; the smallest mistake of units (inch for cm) is a factor of 2.5."""
SAME = 1.05
"""Cameras whose ratios differ by less have one reason."""
FACTORS = (1000.0, 100.0, 10.0, 8.0, 5.0, 4.0, 2.54, 1.25)
"""Between units of depth that cameras and data sets use: m, cm, mm; 0.1, 0.125, 0.2 (TUM) and 0.25 mm; inches."""
UNITS_M = (0.001, 0.0002, 0.0001, 0.00025, 0.000125, 0.01)
"""Metres for each unit of 16-bit depth images, the most usual first."""
CLIPPED_WIDTH = 1e-4
CLIPPED_SHARE = 0.05
"""Of a camera's depths on the board that may be equal to the largest within `CLIPPED_WIDTH`: noise of a millimetre at 2 m leaves
next to none."""
ALONG_RAY = 0.3
"""About an exponent of 1. A depth field of 10 mm at 2 m, or a focal length 2 % off, makes 0.1 of 0."""
MIN_RAYS, LEAST_SPREAD = 100, 0.01
"""Corners, and standard deviation of the logarithm of their rays' lengths: half of the corners 10 degrees from the axis."""
WITHIN = 1.09
"""Depth over pixels is that near to the true factor, where the lens is known or estimated; 4 and 5, 8 and 10 stay apart."""


def likely_factor(ratio: float) -> float | None:
    """The factor, or one over it, by which depth seems to be in another unit, from measured depth over its distance by
    the pixels; None where the ratio is near none (near 1 included)."""
    for factor in FACTORS:
        for value in (factor, 1 / factor):
            if value / WITHIN < ratio < value * WITHIN:
                return value
    return None


def name_factor(ratio: float) -> str:
    """What a ratio of measured depth to its distance by the pixels says of the unit, in words; empty where nothing."""
    factor = likely_factor(ratio)
    if factor is None:
        return ""
    return (
        f"depth_scale looks {factor:g} times too large"
        if factor > 1
        else f"depth_scale looks {1 / factor:g} times too small"
    )


def unit_of_depth(raw: FloatArray, distance_m: FloatArray, within: float = WITHIN) -> float | None:
    """Metres for each unit of depth, of the units that are in use; None where none, or more than one, fits.

    Parameters
    ----------
    raw
        Depth (n,) of boards, as stored.
    distance_m
        Their distances (n,), metres, by the pixels.
    within
        By which factor focal lengths may be wrong.
    """
    measured = np.isfinite(raw) & (raw > 0) & (distance_m > 0)
    if not np.any(measured):
        return None
    unit_m = float(np.median(distance_m[measured] / raw[measured]))
    fitting = [u for u in UNITS_M if u / within < unit_m < u * within]
    return fitting[0] if len(fitting) == 1 else None


def clipped_share(depth_m: FloatArray, width: float = CLIPPED_WIDTH) -> float:
    """Share of depths (n,) that are equal to the largest within `width`; 0 for none."""
    z_m = depth_m[np.isfinite(depth_m)]
    return float(np.mean(z_m > (1 - width) * z_m.max())) if len(z_m) else 0.0


def depth_over_pixels(posed: PosedView, board: Board, bias: DepthBias | None) -> float | None:
    """Median of measured depth, its bias removed, over the distance of the board by its pixels; None without depth."""
    measured = np.isfinite(posed.view.depth_m)
    if measured.sum() < max(len(measured) // 2, 1):
        return None
    z_m = se3.transform(posed.T_color_face, board.corners_m()[posed.view.ids[measured]])[:, 2]
    depth_m = posed.view.depth_m[measured]
    return float(np.median((depth_m if bias is None else bias.correct(depth_m)) / z_m))


def growth_with_ray(posed: Sequence[PosedView], board: Board) -> float | None:
    """The exponent with which measured depth over that of the board by its pixels grows with the length of the ray (x, y, 1): 0
    for depth along the axis, 1 for distances along the rays. None where the views do not tell it."""
    ratios, rays = [np.empty(0)], [np.empty(0)]
    for p in posed:
        points = se3.transform(p.T_color_face, board.corners_m()[p.view.ids])
        measured = np.isfinite(p.view.depth_m) & (p.view.depth_m > 0)
        ratios.append(np.log(p.view.depth_m[measured] / points[measured, 2]))
        rays.append(np.log(np.linalg.norm(points[measured], axis=1) / points[measured, 2]))
    ratio, ray = np.concatenate(ratios), np.concatenate(rays)
    if len(ray) < MIN_RAYS or np.std(ray) < LEAST_SPREAD:
        return None
    return float(np.polyfit(ray, ratio, 1)[0])


def check_axis(posed: Sequence[PosedView], board: Board) -> None:
    """Refuse depth that is measured along each pixel's ray.

    Raises
    ------
    CalibrationError
        Names the cameras, and how to convert it.
    """
    by_camera: dict[str, list[PosedView]] = {}
    for p in posed:
        by_camera.setdefault(p.view.camera, []).append(p)
    growth = {name: growth_with_ray(own, board) for name, own in by_camera.items()}
    wrong = [name for name, own in growth.items() if own is not None and abs(own - 1) < ALONG_RAY]
    if wrong:
        raise CalibrationError(
            f"{', '.join(wrong)}: depth along the camera's axis expected, distances along the rays of the pixels found: they grow "
            "towards the border of the image as the rays do. Divide each by the length of its ray (x, y, 1), by the lens"
        )


def check_depth_scale(
    posed: Sequence[PosedView], board: Board, biases: Mapping[str, DepthBias], scale_sd: float = 0.0
) -> None:
    """Refuse depth that has nothing to do with the pixels.

    `scale_sd` is how well the scale of depth is known; what is within three of it passes.

    Raises
    ------
    CalibrationError
        The depth of a camera is 25 % off, in the median of its views: names the cameras, and what to look at. Or its bias is.
    """
    ratios: dict[str, list[float]] = {}
    for p in posed:
        ratio = depth_over_pixels(p, board, biases.get(p.view.camera))
        if ratio is not None:
            ratios.setdefault(p.view.camera, []).append(ratio)
    usual = {name: float(np.median(own)) for name, own in ratios.items()}
    wrong = {
        name: r
        for name, r in usual.items()
        if abs(r - 1) > 3 * scale_sd and (not 1 / MAX_RATIO < r < MAX_RATIO or likely_factor(r) is not None)
    }
    if not wrong:
        return
    for name in wrong:
        raw = [depth_over_pixels(p, board, None) for p in posed if p.view.camera == name and name in biases]
        measured = float(np.median([r for r in raw if r is not None] or [np.nan]))
        if 1 / WITHIN < measured < WITHIN:
            raise CalibrationError(
                f"{name}: depth on the board agrees with the pixels as it is measured ({measured:.3g} of the distance), and not with its "
                f"depth bias taken off ({wrong[name]:.3g}). Check the distances of the bias recording, and that they stand beside "
                "the right frames"
            )
        depth_m = np.concatenate([p.view.depth_m for p in posed if p.view.camera == name])
        if clipped_share(depth_m) > CLIPPED_SHARE:
            raise CalibrationError(
                f"{name}: {100 * clipped_share(depth_m):.0f} % of its depths on the board are {np.nanmax(depth_m):.3g} m, and none is "
                "more: they are clipped, by the sensor or by a conversion. Keep the board within the sensor's range, and convert "
                "depth without a limit"
            )
    named = ", ".join(f"{name} {r:.3g}" for name, r in wrong.items())
    low, high = min(usual.values()), max(usual.values())
    if len(wrong) == len(usual) and high < SAME * low:
        todo = (
            f"All cameras agree: measure the board's squares ({1e3 * board.square_m:g} mm stated), and check depth_scale "
            "(metres for each unit of the depth images)"
        )
    else:
        todo = "Check depth_scale of these cameras (metres for each unit of their depth images), and their intrinsics"
    factors = {factor: name for name, r in wrong.items() if (factor := name_factor(r))}
    todo += "".join(f" ({name}: {factor})" for factor, name in factors.items())
    raise CalibrationError(
        f"{', '.join(wrong)}: measured depth over the board's distance by its pixels is {named} in the median of the views; "
        f"{1 / MAX_RATIO:g} to {MAX_RATIO:g} needed. {todo}. Where the scale of depth is not known, set bundle.bias_scale_sd in "
        "a --config file to how far it may be off"
    )

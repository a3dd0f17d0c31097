"""Depth images of recordings in metres: integers in units of a scale, or floating point."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.images import read_image

NO_MEASUREMENT = 65535
"""Besides 0, what 16-bit depth images have where nothing was measured, whatever else they use."""
FARTHEST_M = 60.0
"""Of the median of an image of floating-point depth: beyond it the unit is another one than metres."""


def read_depth_raw(path: Path, size: tuple[int, int], who: str) -> np.ndarray:
    """A depth image (height, width) as stored: uint16 or floating point.

    Parameters
    ----------
    size
        Width and height that it must have, px.
    who
        What says so, as "the colour image has".

    Raises
    ------
    ConfigError
        The file is damaged, of another size, or neither 16-bit integers nor floating point with one channel.
    """
    raw = read_image(path, size, who)
    if raw.ndim == 2 and raw.dtype.kind in "iu" and raw.dtype.itemsize > 2 and raw.min() >= 0 and raw.max() < 65536:
        raw = raw.astype(np.uint16)
    if raw.ndim != 2 or not (raw.dtype == np.uint16 or raw.dtype.kind == "f"):
        channels = 1 if raw.ndim == 2 else raw.shape[2]
        raise ConfigError(
            f"{path}: {raw.dtype.itemsize * 8} bits and {channels} channel(s) seen, depth needs 16 bits and one, or floating "
            "point. Save the sensor's depth as a 16-bit greyscale PNG, not a picture of it"
        )
    return raw


def depth_in_m(
    raw: np.ndarray, scale_m: float, float_unit_m: float, invalid: tuple[float, ...], where: str
) -> np.ndarray:
    """Depth (height, width), float64, metres, NaN where there is none.

    Parameters
    ----------
    raw
        (height, width), uint16 in units of `scale_m`, or floating point in units of `float_unit_m`.
    invalid
        Values that mean "no measurement", besides 0, negative, infinite, and 65535.
    where
        Names the image in errors.

    Raises
    ------
    ConfigError
        Floating-point depth that cannot be metres.
    """
    floating = raw.dtype.kind == "f"
    values = raw.astype(float)
    none = ~np.isfinite(values) | (values <= 0) | (values == NO_MEASUREMENT)
    for value in invalid:
        none |= values == value
    depth_m = values * (float_unit_m if floating else scale_m)
    depth_m[none] = np.nan
    if floating and not none.all():
        usual_m = float(np.median(depth_m[~none]))
        if usual_m > FARTHEST_M:
            raise ConfigError(
                f"{where}: floating-point depth of {usual_m:.4g} m in the median seen, less than {FARTHEST_M:g} m needed. If it "
                f"is in millimetres, write `depth: {{scale_m: {float_unit_m / 1000:g}}}` under the camera in dataset.yaml"
            )
    return depth_m

"""Lens models of RealSense and Orbbec devices as OpenCV's: the same where they are, fitted where they are not.

Their names are those of librealsense (`Inverse Brown Conrady`, `distortion.inverse_brown_conrady`) and Orbbec's numbers.
Pixel (0, 0) is the centre of the top left pixel. The formulas are those of librealsense's rsutil.h.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.lens_fit import fit_lens, image_grid
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.calibrations.common import Numbers, Size, lens, numbers
from rgbd_calib.io.tables import short

ORBBEC = ("none", "modified", "inverse", "brown", "brown", "kannala")
"""OBCameraDistortionModel: none, modified and inverse Brown-Conrady, Brown-Conrady, the same with k1 to k6, Kannala-Brandt."""
MAX_OFF_PX = 0.05
"""Of a lens that stands for another model: a fifth of what corners are found to."""


def lens_of_maker(
    path: Path,
    camera: str,
    size: Size,
    focal: Numbers,
    centre: Numbers,
    model: str,
    coefficients: Numbers,
) -> tuple[Intrinsics, str]:
    """The lens, and a note where it is a fit to another model (empty where it is the same).

    Parameters
    ----------
    coefficients
        In OpenCV's order: k1, k2, p1, p2, k3, and k4, k5, k6 where the model has them; four of Kannala-Brandt.

    Raises
    ------
    ConfigError
        A model that is not known, or one that OpenCV's does not come near.
    """
    kind = _kind(model)
    k = numbers(path, f"{camera}: coefficients", coefficients)
    if not np.any(k) and kind != "kannala":
        kind = "none"
    if kind == "kannala":
        return lens(path, camera, size, focal, centre, k[:4], fisheye=True), ""
    if kind == "none":
        return lens(path, camera, size, focal, centre), ""
    if kind == "brown":
        return lens(path, camera, size, focal, centre, k), ""
    if kind not in ("inverse", "modified") or len(k) < 5 or np.any(k[5:]):
        raise ConfigError(
            f"{path}: {camera}: lens model {short(model)} seen; Brown Conrady, its inverse or modified form, or Kannala Brandt "
            "needed. Calibrate the lens with `rgbd-calib intrinsics`"
        )
    start = lens(path, camera, size, focal, centre)
    if kind == "inverse":
        pixels = image_grid(*size)
        xy = (pixels - start.vector[2:4]) / start.vector[:2]
        directions = _with_one(_brown_conrady(k, xy))
    else:
        # the model projects; its directions cover the image and a little more
        xy = 1.05 * (image_grid(*size) - start.vector[2:4]) / start.vector[:2]
        pixels, directions = _modified(k, xy) * start.vector[:2] + start.vector[2:4], _with_one(xy)
    found = fit_lens(start, pixels, directions, len(start.distortion), keep_K=True)
    if not found.max_px < MAX_OFF_PX:
        raise ConfigError(
            f"{path}: {camera}: lens model {short(model)}: OpenCV's lens comes within {found.max_px:.2g} px of it, "
            f"{MAX_OFF_PX:g} px needed. Calibrate the lens with `rgbd-calib intrinsics`"
        )
    return found.intrinsics, f"{camera}: lens {model} as OpenCV's, within {found.max_px:.1g} px"


def _kind(model: str) -> str:
    words = str(model).lower().replace("_", " ").replace("-", " ").replace(".", " ")
    for name in ("inverse", "modified", "kannala", "ftheta"):
        if name in words:
            return name
    return "brown" if "brown" in words else "none" if "none" in words or not words.strip() else words


def _brown_conrady(k: FloatArray, xy: FloatArray) -> FloatArray:
    x, y = xy.T
    r2 = x * x + y * y
    g = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    return np.stack(
        [x * g + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x), y * g + 2 * k[3] * x * y + k[2] * (r2 + 2 * y * y)], axis=1
    )


def _modified(k: FloatArray, xy: FloatArray) -> FloatArray:
    """The tangential part acts on what the radial part has made."""
    r2 = np.sum(xy * xy, axis=1)
    x, y = xy.T * (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4])))
    return np.stack(
        [x + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x), y + 2 * k[3] * x * y + k[2] * (r2 + 2 * y * y)], axis=1
    )


def _with_one(xy: FloatArray) -> FloatArray:
    return np.column_stack([xy, np.ones(len(xy))])

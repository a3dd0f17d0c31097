"""Whole depth images: from what was reported to points, and into the geometry of another camera."""

from __future__ import annotations

from itertools import product

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.depth_sensor import DepthSensor
from rgbd_calib.geometry.so3 import FloatArray

REACH_PX = 0.52
"""Half the side of a pixel, and a little, so that pixels that stand beside each other leave no gap."""


class DepthImage:
    """A depth sensor over its whole image; what does not depend on the depth is computed once."""

    def __init__(self, sensor: DepthSensor) -> None:
        lens = sensor.camera.intrinsics
        u, v = np.meshgrid(np.arange(lens.width, dtype=float), np.arange(lens.height, dtype=float))
        pixels = np.stack([u, v], axis=-1)
        self._sensor, self._rays = sensor, lens.rays(pixels)
        self._stretch = np.linalg.norm(self._rays, axis=-1)
        self._field = None if sensor.field is None else sensor.field.at(pixels)

    def points(self, depth_m: FloatArray) -> FloatArray:
        """Points (height, width, 3), metres, in the colour camera's frame; NaN without depth, or beyond the lens model."""
        bias = self._sensor.bias
        z_m = depth_m if bias is None else bias.correct(depth_m, self._stretch)
        z_m = z_m if self._field is None else z_m + self._field(depth_m)
        return se3.transform(self._sensor.camera.T_color_depth, z_m[..., None] * self._rays)


def seen_by(points_m: FloatArray, lens: Intrinsics, pixel: float = 1.0) -> FloatArray:
    """Depth image (height, width), metres, of points (..., 3) in the frame of a camera with this lens; NaN where there is none.

    The nearest point of a pixel counts (z-buffer). Each point covers the square of one pixel of its sensor, which is `pixel`
    pixels of this camera wide, and no more: what the sensor did not see stays empty.
    """
    reach_px = REACH_PX * pixel
    around = range(-int(reach_px + 0.5), int(reach_px + 0.5) + 1)
    flat = points_m.reshape(-1, 3)
    flat = flat[np.isfinite(flat).all(axis=1) & (flat[:, 2] > 0)]
    pixels, z_m = lens.project(flat), flat[:, 2]
    inside = np.isfinite(pixels).all(axis=1) & (np.abs(2 * pixels + 1 - lens.size_px) <= lens.size_px + 2).all(axis=1)
    pixels, z_m = pixels[inside], z_m[inside]
    nearest, middle = np.full((lens.height, lens.width), np.inf), np.rint(pixels).astype(int)
    for step in product(around, around):
        at = middle + step
        hit = (np.abs(at - pixels) <= reach_px).all(axis=1) & (at >= 0).all(axis=1) & (at < lens.size_px).all(axis=1)
        u, v = at[hit].T
        np.minimum.at(nearest, (v, u), z_m[hit])
    return np.where(np.isfinite(nearest), nearest, np.nan)

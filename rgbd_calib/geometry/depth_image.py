"""Whole depth images: from what was reported to points, and into the geometry of another camera."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.depth_error import FIELD_AT_M, CellPattern, PolynomialField
from rgbd_calib.geometry.depth_sensor import DepthSensor
from rgbd_calib.geometry.so3 import FloatArray

ROWS_AT_ONCE = 64
"""Of an image, whose shapes are in memory together: some 50 MB."""
COVER = 0.02
"""By how much pixels that stand beside each other overlap, px."""


class DepthImage:
    """A depth sensor over a whole image (width, height); what does not depend on the depth is computed once."""

    def __init__(self, sensor: DepthSensor, width: int, height: int) -> None:
        u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
        self._sensor, self._pixels_px = sensor, np.stack([u, v], axis=-1)
        self._rays = sensor.camera.intrinsics.rays(self._pixels_px)
        self._maps: tuple[tuple[int | None, FloatArray], ...] = ()
        if isinstance(sensor.field, PolynomialField):
            own, size_px = sensor.field, np.array([sensor.field.width, sensor.field.height], float)
            smooth = replace(own, pattern=None, min_m=0.0, max_m=np.inf)
            at = np.full((height, width), FIELD_AT_M)
            rows = [slice(k, k + ROWS_AT_ONCE) for k in range(0, height, ROWS_AT_ONCE)]
            whole = np.concatenate([smooth.error_m(self._pixels_px[r], at[r]) for r in rows])
            patterns = own.pattern and [
                (
                    p,
                    CellPattern((p,), own.pattern.values[k : k + 1]).error_m(
                        self._pixels_px, np.ones_like(at), size_px
                    ),
                )
                for k, p in enumerate(own.pattern.powers)
            ]
            self._maps = ((None, whole), *(patterns or ()))

    def points(self, depth_m: FloatArray) -> FloatArray:
        """Points (height, width, 3), metres, in the colour camera's frame; NaN without depth, or beyond the lens model."""
        sensor = self._sensor
        z_m = depth_m if sensor.bias is None else sensor.bias.correct(depth_m)
        if isinstance(sensor.field, PolynomialField):
            held = np.clip(depth_m, sensor.field.min_m, sensor.field.max_m)
            for power, shape in self._maps:
                z_m = z_m + shape * (sensor.field.growth_at(held) if power is None else held**power)
        elif sensor.field is not None:
            z_m = z_m + sensor.field.error_m(self._pixels_px, depth_m)
        return np.asarray(se3.transform(sensor.camera.T_color_depth, z_m[..., None] * self._rays))


def seen_by(points_m: FloatArray, lens: Intrinsics, scale: float = 1.0) -> FloatArray:
    """Depth image (height, width), metres, of points (..., 3) in the frame of a camera with this lens; NaN where there is none.

    The nearest point of a pixel counts (z-buffer). Each point covers the square of `scale` pixels that its own pixel subtended,
    and no more: what the sensor did not see stays empty.
    """
    flat = points_m.reshape(-1, 3)
    flat = flat[np.isfinite(flat).all(axis=1) & (flat[:, 2] > 0)]
    pixels, z_m = lens.project(flat), flat[:, 2]
    inside = np.isfinite(pixels).all(axis=1) & (np.abs(2 * pixels + 1 - lens.size_px) <= lens.size_px + 2 * scale).all(
        axis=1
    )
    pixels, z_m = pixels[inside], z_m[inside]
    nearest = np.full((lens.height, lens.width), np.inf)
    reach, middle = max(scale, 1.0) / 2 + COVER, np.rint(pixels).astype(int)
    around = range(-int(np.ceil(reach)), int(np.ceil(reach)) + 1)
    for du, dv in product(around, around):
        u, v = middle[:, 0] + du, middle[:, 1] + dv
        hit = (np.abs(u - pixels[:, 0]) <= reach) & (np.abs(v - pixels[:, 1]) <= reach)
        hit &= (u >= 0) & (u < lens.width) & (v >= 0) & (v < lens.height)
        np.minimum.at(nearest, (v[hit], u[hit]), z_m[hit])
    return np.where(np.isfinite(nearest), nearest, np.nan)

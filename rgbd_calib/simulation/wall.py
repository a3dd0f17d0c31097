"""A wall square to a camera, for calibrating its depth: light paint with a taped cross where the axis meets it."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation import textures
from rgbd_calib.simulation.render import Picture, View

_PAINT = textures.plain("wall", "d9d3c5")
_TAPE = textures.hex_color("3c5f8a")
_TAPE_WIDTH_M, _TAPE_LENGTH_M = 0.019, 0.3


def render_wall(view: View, distance_m: float, rng: np.random.Generator) -> Picture:
    """The picture of an endless wall at `distance_m` along the optical axis."""
    h, w = view.shape
    on_wall = view.in_camera * distance_m  # (h * w, 3)
    x, y = on_wall[:, 0], on_wall[:, 1]
    albedo = textures.albedo(_PAINT, x, y, np.full(len(x), float(rng.integers(1000))))
    pixel_m = distance_m / view.intrinsics.fx
    for a, b in ((x, y), (y, x)):
        # the tape's share of each pixel, edges spread over one pixel
        share = np.clip((_TAPE_WIDTH_M / 2 - np.abs(a)) / pixel_m + 0.5, 0, 1)
        share *= np.clip((_TAPE_LENGTH_M / 2 - np.abs(b)) / pixel_m + 0.5, 0, 1)
        albedo = albedo * (1 - share[:, None]) + textures.linear(np.array(_TAPE)) * share[:, None]
    light = 0.75 / (1 + 0.08 * (x**2 + (y + 0.5) ** 2))
    cos: FloatArray = distance_m / np.linalg.norm(on_wall, axis=1)
    image = (albedo * light[:, None]).astype(np.float32).reshape(h, w, 3)
    return Picture(image, np.full((h, w), distance_m), cos.reshape(h, w))

"""Infrared reflectance of the scene, and infrared images of depth cameras.

Most dyes and paints reflect more in the near infrared than in visible light; toner is carbon and stays dark, at about 0.1. The
illumination is next to the lens: no shadows, and a decrease with the square of the distance.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.bent import BentFace
from rgbd_calib.simulation.scene import Caster
from rgbd_calib.simulation.surfaces import SeenBoard, albedo, board_albedo, on_surface
from rgbd_calib.simulation.view import View

_BLUR_PX = 0.5
_FULL = {np.dtype(np.uint16): 30000.0, np.dtype(np.uint8): 200.0}
"""Pixel value of white paper at 1 m."""
_PHOTONS = 20000.0
"""Photons at that value: noise is 1/140 of it."""
_FLOOR = 2e-4


def reflectance(color: FloatArray) -> FloatArray:
    """Infrared reflectance (n,) of surfaces with a linear colour (n, 3)."""
    return np.asarray(0.06 + 0.85 * color.mean(axis=-1) ** 0.7)


def room_reflectance(view: View, caster: Caster) -> FloatArray:
    """Infrared reflectance (h, w) at the pixel centres."""
    hits = caster.cast(view.origin_m, view.centres)
    seen = np.flatnonzero(hits.quad >= 0)
    points = view.origin_m + hits.t[seen, None] * view.centres[seen]
    out = np.zeros(len(hits.quad))
    color, _ = albedo(caster.scene, hits.quad[seen], *on_surface(caster.scene, hits.quad[seen], points))
    out[seen] = reflectance(color)
    return out.reshape(view.shape)


def with_board_reflectance(
    view: View,
    room: FloatArray,
    board_caster: Caster,
    seen: SeenBoard,
    bent: Mapping[int, BentFace],
    rng: np.random.Generator,
) -> FloatArray:
    """Reflectance (h, w) of the room with the board in front, averaged over pixels at the edges of the print."""
    out = room.copy()
    every = np.arange(len(seen.pixels))
    color = board_albedo(view, board_caster.scene, seen, every, bent, rng)
    out.reshape(-1)[seen.pixels] = reflectance(color)
    return out


def infrared_image(
    amplitude: FloatArray, kind: type[np.uint8] | type[np.uint16], rng: np.random.Generator
) -> np.ndarray:
    """The image (h, w) for amplitudes (h, w); 1 is a perfect reflector at 1 m, facing the camera."""
    light = cv2.GaussianBlur(amplitude.astype(np.float32), (0, 0), _BLUR_PX, borderType=cv2.BORDER_REPLICATE)
    noise = np.sqrt(np.maximum(light, 0) / _PHOTONS + _FLOOR**2)
    light = light + noise * rng.standard_normal(light.shape, dtype=np.float32)
    return np.clip(np.round(_FULL[np.dtype(kind)] * light), 0, np.iinfo(kind).max).astype(kind)

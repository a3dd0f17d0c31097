"""What a colour camera makes of the light: blur, noise, the sRGB curve and 8 bits."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rgbd_calib.simulation import textures
from rgbd_calib.simulation.render import Picture


@dataclass(frozen=True)
class ColorNoise:
    """Lens and sensor of the colour camera."""

    blur_px: float = 0.6
    """Deviation of the lens's point spread, beside the pixel's own square."""
    sigma_grey: float = 1.5
    """Noise at middle grey, in steps of 255; it grows with the root of the light."""
    vignette: float = 0.12
    """Light lost in the image's corners."""


def develop(picture: Picture, noise: ColorNoise, rng: np.random.Generator) -> np.ndarray:
    """The image (h, w, 3), uint8, B G R, that the colour camera gives."""
    light: np.ndarray = np.asarray(picture.light, np.float32)
    h, w = light.shape[:2]
    if noise.blur_px > 0:
        light = cv2.GaussianBlur(light, (0, 0), noise.blur_px, borderType=cv2.BORDER_REPLICATE)
    y, x = np.mgrid[:h, :w].astype(np.float32)
    r2 = ((x - (w - 1) / 2) ** 2 + (y - (h - 1) / 2) ** 2) / ((w / 2) ** 2 + (h / 2) ** 2)
    light = light * (1 - noise.vignette * r2)[..., None]
    # photon noise: the curve's slope at middle grey (0.214 linear) turns grey steps into light
    middle, slope = 0.214, 1.16
    sigma = noise.sigma_grey / 255 / slope * np.sqrt((np.maximum(light, 0) + 0.02) / (middle + 0.02))
    light = light + sigma * rng.standard_normal(light.shape, dtype=np.float32)
    return np.round(255 * textures.encode(light)).astype(np.uint8)[..., ::-1]

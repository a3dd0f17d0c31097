"""The colour camera: defocus, chromatic aberration, exposure, noise, sRGB curve and quantisation.

A point at depth z is blurred to a disc of diameter K |1/z - 1/z_focus|, with K the focal length in px times the aperture diameter:
1.1 px m for 550 px and 2 mm. A disc of diameter D is approximated by a Gaussian with the same standard deviation, D / 4.

Auto exposure brings the image mean to middle grey without saturating more than a few pixels, up to a small error. Noise is photon
noise and grows with the gain.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rgbd_calib.simulation import textures
from rgbd_calib.simulation.render import IdealImage

_NOISE_FLOOR = 0.02
_MIDDLE, _SLOPE = 0.214, 1.16
"""Linear light of middle grey and the slope of the sRGB curve there, to convert grey levels to light."""
_MEAN = 0.18
"""Target mean of the linear image."""
_BURNT, _BURNT_SHARE = 0.97, 0.995
_GAINS = (0.3, 8.0)
_METER_STEP = 8
"""Exposure is metered on every eighth pixel in each direction."""


@dataclass(frozen=True)
class ColorNoise:
    """Lens and sensor of the colour camera."""

    blur_px: float = 0.6
    """Deviation of the lens's point spread, beside the pixel's own square."""
    sigma_grey: float = 1.5
    """Noise at middle grey, in steps of 255; it grows with the root of the light."""
    vignette: float = 0.12
    """Light lost in the image's corners."""
    fringe_px: float = 0.0
    """Lateral chromatic aberration: radial shift of red outwards and of blue inwards in the image corners."""


@dataclass(frozen=True)
class Optics:
    """Focus and auto exposure."""

    focus_m: float
    defocus_px_m: float
    """K, px m; 0: no defocus."""
    exposure_error: float
    """Relative standard deviation of the exposure."""


def develop(
    picture: IdealImage,
    noise: ColorNoise,
    rng: np.random.Generator,
    optics: Optics | None = None,
    lit: np.ndarray | None = None,
) -> np.ndarray:
    """The image (h, w, 3), uint8, B G R, that the colour camera gives.

    Without `optics`, no defocus and a fixed exposure. `lit` (h, w): illumination relative to the picture's.
    """
    light: np.ndarray = np.asarray(picture.light, np.float32)
    h, w = light.shape[:2]
    if lit is not None:
        light = light * lit[..., None].astype(np.float32)
    light = _blurred(light, picture.z_m, noise.blur_px, optics)
    if noise.fringe_px:
        light = _fringed(light, noise.fringe_px)
    y, x = np.mgrid[:h, :w].astype(np.float32)
    r2 = ((x - (w - 1) / 2) ** 2 + (y - (h - 1) / 2) ** 2) / ((w / 2) ** 2 + (h / 2) ** 2)
    light = light * (1 - noise.vignette * r2)[..., None]
    gain = 1.0
    if optics is not None:
        gain = _exposure(light, optics, rng)
        light = light * np.float32(gain)
    sigma = noise.sigma_grey / 255 / _SLOPE * np.sqrt((np.maximum(light, 0) + _NOISE_FLOOR) / (_MIDDLE + _NOISE_FLOOR))
    light = light + sigma * np.float32(np.sqrt(gain)) * rng.standard_normal(light.shape, dtype=np.float32)
    return np.round(255 * textures.encode(light)).astype(np.uint8)[..., ::-1]


def _blurred(light: np.ndarray, z_m: np.ndarray, blur_px: float, optics: Optics | None) -> np.ndarray:
    sharp = light if blur_px == 0 else cv2.GaussianBlur(light, (0, 0), blur_px, borderType=cv2.BORDER_REPLICATE)
    if optics is None or optics.defocus_px_m == 0:
        return sharp
    sigma2 = (optics.defocus_px_m / 4 * np.abs(1 / np.maximum(z_m, 0.1) - 1 / optics.focus_m)) ** 2
    most2 = float(sigma2.max())
    soft = cv2.GaussianBlur(light, (0, 0), float(np.sqrt(blur_px**2 + most2)), borderType=cv2.BORDER_REPLICATE)
    # the variance of a mixture of two Gaussians is the weighted mean of their variances
    weight = (sigma2 / max(most2, 1e-12)).astype(np.float32)[..., None]
    return np.asarray(sharp + weight * (soft - sharp))


def _fringed(light: np.ndarray, fringe_px: float) -> np.ndarray:
    """Red (first channel) magnified and blue (last) reduced about the image centre."""
    h, w = light.shape[:2]
    out = light.copy()
    for channel, sign in ((0, 1), (2, -1)):
        scale = 1 + sign * fringe_px / np.hypot(w / 2, h / 2)
        M = np.array([[scale, 0, (1 - scale) * (w - 1) / 2], [0, scale, (1 - scale) * (h - 1) / 2]])
        plane = np.ascontiguousarray(light[..., channel])
        out[..., channel] = cv2.warpAffine(plane, M, (w, h), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return out


def _exposure(light: np.ndarray, optics: Optics, rng: np.random.Generator) -> float:
    metered = light[::_METER_STEP, ::_METER_STEP].mean(axis=-1)
    gain = min(_MEAN / metered.mean(), _BURNT / np.quantile(metered, _BURNT_SHARE))
    return float(np.clip(gain * np.exp(rng.normal(0, optics.exposure_error)), *_GAINS))

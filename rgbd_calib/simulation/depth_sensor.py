"""A triangulating depth sensor: structured light, or two cameras.

A true depth z becomes the sensor's biased depth z_m, with z = z_m + bias(z_m), and then a disparity d = f b / z_m,
which gets noise, correlated over the matching window, and is quantised. A deviation sigma_d makes
sigma_z = z^2 sigma_d / (f b) = k z^2.

References
----------
K. Khoshelham, S. Oude Elberink, Accuracy and resolution of Kinect depth data, Sensors 12(2), 2012. C. Nguyen, S. Izadi,
D. Lovell, Modeling Kinect sensor noise for improved 3D reconstruction and tracking, 3DIMPVT 2012 (oblique surfaces).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.depth_field import SensorField, reported
from rgbd_calib.types import DepthBias


@dataclass(frozen=True)
class DepthNoise:
    """What is wrong with a depth sensor; the values are those of a Kinect or an Xtion."""

    focal_px: float = 575.0
    baseline_m: float = 0.075
    k_per_m: float = 1.6e-3
    """sigma_z = k z^2, quantisation included."""
    disparity_step_px: float = 1 / 8
    window_px: tuple[int, int] = (9, 7)
    """Width and height of the matching window: noise is correlated over it."""
    min_m: float = 0.45
    max_m: float = 6.0
    edge_step_px: float = 1.0
    """A jump of disparity between neighbours that leaves no measurement beside it."""
    grazing_cos: float = 0.17
    """No measurement where the cosine between ray and surface normal is less (80 degrees)."""
    oblique_m: float = 0.0
    """Additional noise on oblique surfaces, oblique_m / sqrt(z) theta^2 / (pi/2 - theta)^2, theta the angle to the normal."""
    ideal: bool = False
    """True: no noise, no quantisation, no bias and no holes but those of range."""

    @property
    def product(self) -> float:
        """Focal length times baseline, px m."""
        return self.focal_px * self.baseline_m


STEREO = DepthNoise(
    focal_px=385.0, baseline_m=0.050, k_per_m=4.0e-3, disparity_step_px=1 / 32, window_px=(13, 9), min_m=0.3, max_m=8.0
)
"""Active stereo like a RealSense D435: 0.08 px disparity noise."""


def biased(z_true_m: FloatArray, bias: DepthBias) -> FloatArray:
    """The depth z_m that a sensor with this bias reports, so that ``bias.correct(z_m) == z_true_m``."""
    z_m = np.array(z_true_m, float)
    for _ in range(8):  # a contraction by the slope of the bias, a few per cent a round
        z_m = z_true_m - (bias.correct(z_m) - z_m)
    return z_m


def measure(
    z_true_m: FloatArray,
    cos_incidence: FloatArray,
    noise: DepthNoise,
    bias: DepthBias,
    rng: np.random.Generator,
    field: SensorField | None = None,
) -> np.ndarray:
    """Depth image (h, w) in whole millimetres, uint16, 0 where there is no measurement.

    `z_true_m` (h, w) is along the optical axis, inf where nothing is; `cos_incidence` (h, w).
    """
    seen = np.isfinite(z_true_m)
    z_m = np.where(seen, z_true_m, noise.max_m + 1)
    if not noise.ideal:
        seen &= ~_holes(z_m, cos_incidence, noise, rng)
        z_m = biased(z_m, bias) if field is None else reported(z_m, bias, field)
        noise_px = _noise_px(z_m.shape, noise, rng)
        if noise.oblique_m:
            noise_px *= _oblique(z_m, cos_incidence, noise)
        disparity = noise.product / z_m + noise_px
        disparity = np.round(disparity / noise.disparity_step_px) * noise.disparity_step_px
        z_m = noise.product / np.maximum(disparity, noise.disparity_step_px)
    seen &= (z_m > noise.min_m) & (z_m < noise.max_m)
    return np.where(seen, np.round(z_m * 1000), 0).astype(np.uint16)


def _noise_px(shape: tuple[int, ...], noise: DepthNoise, rng: np.random.Generator) -> FloatArray:
    """Disparity noise (h, w), px: white noise seen through the matching window.

    Its deviation leaves room for the quantisation, a uniform error of step / sqrt(12), within k.
    """
    total_px = noise.k_per_m * noise.product
    sigma_px = np.sqrt(max(total_px**2 - noise.disparity_step_px**2 / 12, 0.0))
    width, height = noise.window_px
    white = rng.standard_normal((shape[0] + height - 1, shape[1] + width - 1))
    rows = np.cumsum(np.pad(white, ((1, 0), (0, 0))), axis=0)
    columns = np.cumsum(np.pad(rows[height:] - rows[:-height], ((0, 0), (1, 0))), axis=1)
    sums: FloatArray = columns[:, width:] - columns[:, :-width]
    return sigma_px * sums / np.sqrt(width * height)


def _oblique(z_m: FloatArray, cos_incidence: FloatArray, noise: DepthNoise) -> FloatArray:
    """Factor (h, w) of the noise on oblique surfaces."""
    angle = np.arccos(np.clip(cos_incidence, noise.grazing_cos, 1.0))
    more_m = noise.oblique_m / np.sqrt(z_m) * (angle / (np.pi / 2 - angle)) ** 2
    return np.hypot(1.0, more_m / (noise.k_per_m * z_m**2))


def _holes(z_m: FloatArray, cos_incidence: FloatArray, noise: DepthNoise, rng: np.random.Generator) -> np.ndarray:
    """Where the sensor sees no pattern (h, w): in the projector's shadow, at jumps, at grazing angles."""
    disparity = noise.product / z_m
    u = np.arange(z_m.shape[1])
    # the projector stands to the left: pixel u is seen at u - d, and whatever lies further right there in the
    # camera's row but no further right for the projector is in the shadow of something nearer
    at_projector = u - disparity * z_m.shape[1] / 640  # px of this image
    right = np.minimum.accumulate(at_projector[:, ::-1], axis=1)[:, ::-1]
    shadow = at_projector > right + 0.5
    # the foreground is the one with the larger disparity: it is the one to the right here, so it stays
    step = np.zeros(z_m.shape)
    step[:, 1:] = np.abs(np.diff(disparity, axis=1))
    step[1:] = np.maximum(step[1:], np.abs(np.diff(disparity, axis=0)))
    jumps = ndimage.binary_dilation(step > noise.edge_step_px, iterations=1)
    ragged = ndimage.binary_dilation(jumps, iterations=2) & (rng.random(z_m.shape) < 0.5)
    grazing = cos_incidence < noise.grazing_cos * (1 + 0.1 * rng.standard_normal(z_m.shape))
    return shadow | jumps | ragged | grazing

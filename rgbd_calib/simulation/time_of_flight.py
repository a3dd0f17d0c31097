"""A time-of-flight depth sensor, modelled by the phasors that its pixels measure.

A pixel that sees a surface of reflectance rho at range r and an incidence angle with cosine c measures the phasor

    S = A exp(i phi),      A = rho c V / r^2,      phi = 4 pi f r / speed of light

with V the fall-off of the illumination towards the image border. Phasors of several surfaces add up:

* at depth edges within a pixel: flying pixels between the two depths, most of which the sensor detects and invalidates;
* by stray light in the lens and by multipath, whose path is longer. Dark surfaces, and surfaces far behind bright near ones, have
  the largest errors: among them the black squares of a board.

Noise is photon noise, sigma_r = k sqrt(A + A_0) / A with ambient light A_0: some mm at 3 m, more at the image border and on black.
Systematic errors are the periodic error along the range ("wiggling", from odd harmonics of the modulation), a fixed pattern over the
image (both in :func:`time_of_flight_field`), and the temperature drift `drift_m`.

References
----------
H. Sarbolandi, D. Lefloch, A. Kolb, Kinect range sensing: structured-light versus time-of-flight Kinect, CVIU 139, 2015.
E. Lachat et al., First experiences with Kinect v2 sensor for close range 3D modelling, ISPRS Archives XL-5/W4, 2015 (5 mm
during the first half hour). A. Corti et al., A metrological characterization of the Kinect V2, Robotics and Autonomous Systems 75,
2016 (wiggling; noise by range and radius).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.depth_field import SensorField, nodes, rated, reported, rings, waves
from rgbd_calib.types import DepthBias

_LIGHT_M_PER_S = 299792458.0
_PIXEL_BLUR_PX = 0.5
_STRAY_SHARE = 0.08
"""Standard deviation of the spread of stray light, in image widths."""
_STRAY_STEP = 8
"""Stray light is smooth and computed at 1/8 resolution."""
_DETOUR_M = 0.35
"""Extra path length of multipath."""
_DETOUR_SHARE = 0.4
_FLYING_M = 0.03
_RANGE_M = np.round(np.linspace(0.4, 5.2, 97), 4)
_NODES = (17, 13)
_RANK = 5
"""Rank of the approximation of the field, which makes it as fast to evaluate as a separable one."""


@dataclass(frozen=True)
class TimeOfFlight:
    """Properties of the sensor; the defaults are those of a Kinect v2."""

    k_m: float = 0.7e-3
    """Range noise at A = 1 without ambient light, metres: 0.9 mm on white paper at 1 m, facing the camera."""
    other_light: float = 0.1
    """A_0."""
    frequency_hz: float = 80e6
    min_amplitude: float = 0.004
    """Pixels with less are invalid."""
    flying_left: float = 0.4
    """Share of flying pixels that is not invalidated."""
    min_m: float = 0.5
    max_m: float = 4.5
    ideal: bool = False
    """True: no noise and no errors; only the range is limited."""

    @property
    def m_per_rad(self) -> float:
        """Range per radian of phase."""
        return _LIGHT_M_PER_S / (4 * np.pi * self.frequency_hz)


def amplitude(z_m: FloatArray, cos_incidence: FloatArray, reflectance: FloatArray, length: FloatArray) -> FloatArray:
    """Amplitude A (h, w); `length` (h, w) is the length of the rays with z = 1."""
    # illumination fall-off: fourth power of the cosine to the axis
    return np.asarray(reflectance * cos_incidence / (z_m * length) ** 2 / length**4)


def measure_time_of_flight(
    z_true_m: FloatArray,
    cos_incidence: FloatArray,
    reflectance: FloatArray,
    length: FloatArray,
    sensor: TimeOfFlight,
    bias: DepthBias,
    rng: np.random.Generator,
    field: SensorField | None = None,
    drift_m: float = 0.0,
    stray: float = 0.0,
) -> np.ndarray:
    """Depth image (h, w) in whole millimetres, uint16, 0 where there is no measurement.

    `z_true_m`, `cos_incidence` and `reflectance` (h, w) as for :func:`depth_sensor.measure` and :func:`amplitude`; `drift_m` is the
    temperature drift of ranges, `stray` the share of stray light and multipath.
    """
    seen = np.isfinite(z_true_m)
    z_m = np.where(seen, z_true_m, 2 * sensor.max_m)
    if not sensor.ideal:
        r = z_m * length
        A = amplitude(z_m, cos_incidence, reflectance, length)
        off_m, seen_A = _mixed(r, A, sensor, stray)
        flying = np.abs(off_m) > _FLYING_M
        seen &= (seen_A > sensor.min_amplitude) & ~(flying & (rng.random(r.shape) > sensor.flying_left))
        sigma = sensor.k_m * np.sqrt(seen_A + sensor.other_light) / np.maximum(seen_A, 1e-6)
        r = r + off_m + drift_m + sigma * _grain(r.shape, rng)
        z_m = reported(r / length, bias, field)
    seen &= (z_m > sensor.min_m) & (z_m < sensor.max_m)
    return np.where(seen, np.round(z_m * 1000), 0).astype(np.uint16)


def _mixed(r: FloatArray, A: FloatArray, sensor: TimeOfFlight, stray: float) -> tuple[FloatArray, FloatArray]:
    """Range error (h, w), metres, from the sum of phasors, and the resulting amplitude (h, w)."""
    phase = r / sensor.m_per_rad
    S = np.stack([A * np.cos(phase), A * np.sin(phase)], axis=-1).astype(np.float32)
    total = cv2.GaussianBlur(S, (0, 0), _PIXEL_BLUR_PX, borderType=cv2.BORDER_REPLICATE)
    if stray:
        h, w = r.shape
        small = cv2.resize(S, (w // _STRAY_STEP, h // _STRAY_STEP), interpolation=cv2.INTER_AREA)
        small = cv2.GaussianBlur(small, (0, 0), _STRAY_SHARE * w / _STRAY_STEP, borderType=cv2.BORDER_REFLECT)
        turn = 1 + _DETOUR_SHARE * (np.exp(2j * _DETOUR_M / 2 / sensor.m_per_rad) - 1)
        x, y = (
            small[..., 0] * turn.real - small[..., 1] * turn.imag,
            small[..., 0] * turn.imag + small[..., 1] * turn.real,
        )
        total = total + stray * cv2.resize(np.stack([x, y], axis=-1), (w, h), interpolation=cv2.INTER_LINEAR)
    # the phase difference; phase unwrapping is assumed to succeed
    cross = S[..., 0] * total[..., 1] - S[..., 1] * total[..., 0]
    off_m = np.arctan2(cross, np.einsum("hwc,hwc->hw", S, total)) * sensor.m_per_rad
    return off_m, np.hypot(total[..., 0], total[..., 1])


def _grain(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Noise (h, w) of unit standard deviation, correlated between neighbours: drivers smooth slightly."""
    white = rng.standard_normal(shape, dtype=np.float32)
    return cv2.GaussianBlur(white, (0, 0), 0.7) * np.float32(1 / 0.40)


def time_of_flight_field(
    width: int, height: int, length: FloatArray, rms_m: float, rng: np.random.Generator
) -> SensorField:
    """Wiggling along the ray and a fixed pattern over the image, with this RMS up to the variation between devices.

    `length` (a, b): length of the rays with z = 1 at the nodes. The periods of the wiggling, 0.94 and 2.3 m, are those of the fourth
    harmonic at 40 and 16 MHz.
    """
    u, v, x, y = nodes(width, height, _NODES)
    r = length[..., None] * _RANGE_M
    phases = rng.uniform(0, 2 * np.pi, 2)
    wiggle = np.sin(2 * np.pi * r / 0.94 + phases[0]) + 1.5 * np.sin(2 * np.pi * r / 2.3 + phases[1])
    pattern = 1.2 * rings(x, y, rng) + 0.5 * waves(x, y, 2, (1.4, 3.2), rng)
    total = wiggle / length[..., None] + (pattern - pattern.mean())[..., None]
    # low-rank approximation: a sum of a few products
    U, s, Vt = np.linalg.svd(total.reshape(-1, len(_RANGE_M)), full_matrices=False)
    maps = (U[:, :_RANK] * s[:_RANK]).T.reshape(_RANK, *x.shape)
    return rated(SensorField(u, v, _RANGE_M, maps, Vt[:_RANK]), rms_m, rng)


def nodes_px(width: int, height: int) -> FloatArray:
    """Pixels (a, b, 2) of the nodes of :func:`time_of_flight_field`."""
    u, v, _, _ = nodes(width, height, _NODES)
    return np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1)

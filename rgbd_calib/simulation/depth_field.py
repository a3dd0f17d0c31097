"""The depth error of a sensor over its image, in addition to its bias along the range.

    z_true = z + bias(z) + field(u, v, z)            field = sum_k map_k(u, v) profile_k(z)

A triangulating sensor has a disparity error delta(u, v), and so a depth error z^2 delta / (f b). The pattern is specific to the
device: residual distortion of its two lenses (slow waves, and rings that grow towards the border) and, with a projector, faint
column bands with constant offsets and cells of the repeated pattern. No amplitude is published for bands and cells; they are set to
a few thousandths of a pixel, far below the disparity step of 1/8 px. On a Kinect, the distortion decays with the raw disparity
(which grows with distance), delta exp(-alpha_1 d) (Herrera, Kannala, Heikkila 2012).

Maps and profiles are tabulated and interpolated linearly, hence so is their product: truth.yaml has the very field that the images
were made with, rounded to 1e-8 m.

References
----------
D. Herrera, J. Kannala, J. Heikkila, Joint depth and color camera calibration with distortion correction, IEEE PAMI
34(10), 2012. K. Khoshelham, S. Oude Elberink, Accuracy and resolution of Kinect depth data, Sensors 12(2), 2012. J. Smisek,
M. Jancosek, T. Pajdla, 3D with Kinect, ICCV workshops 2011 (fixed pattern of plane residuals).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from rgbd_calib.geometry.depth_error import DepthBias, GridField
from rgbd_calib.geometry.so3 import FloatArray

_NODES = (33, 25)
"""Nodes over the image, 20 px apart at 640 x 480."""
_RANGE_M = np.round(np.geomspace(0.3, 6.0, 24), 4)
_RATED_M = np.linspace(0.8, 3.0, 45)
"""Range over which the RMS of a field is defined."""
_KINECT_C0, _KINECT_C1, _ALPHA = 3.09, -2.83e-3, 1.2e-3
"""1 / z = c0 + c1 d with the raw disparity d of a Kinect, and the decay alpha_1 of its distortion."""
_LENGTHS = (1.4, 3.2)
"""Wavelengths of the slow waves, in half widths of the image."""
_SPREAD = 0.2
"""Relative variation of the magnitude between devices."""
_ROUNDS = 5
"""Fixed-point iterations; each reduces the error, at most 30 mm, to 3 %."""


@dataclass(frozen=True)
class SensorField:
    """A sum of products of a map over the image and a profile along the reported depth."""

    u_px: FloatArray
    """(a,)."""
    v_px: FloatArray
    """(b,)."""
    z_m: FloatArray
    """(c,)."""
    maps: FloatArray
    """(k, a, b)."""
    profiles: FloatArray
    """(k, c), metres."""

    @property
    def grid(self) -> GridField:
        """The field in the form of rig files."""
        return GridField(
            self.u_px, self.v_px, self.z_m, np.round(np.einsum("kab,kc->abc", self.maps, self.profiles), 8)
        )

    @cached_property
    def pixels(self) -> np.ndarray:
        """The maps (k, h, w), float32, at every pixel."""
        u, v = np.arange(self.u_px[-1] + 1), np.arange(self.v_px[-1] + 1)
        out = np.empty((len(self.maps), len(v), len(u)), np.float32)
        for one, own in zip(out, self.maps, strict=True):
            columns = np.stack([np.interp(u, self.u_px, row) for row in own.T])  # (b, w)
            one[:] = np.stack([np.interp(v, self.v_px, column) for column in columns.T], axis=1)
        return out

    def error_m(self, z_m: np.ndarray) -> np.ndarray:
        """field (h, w), metres, for an image of reported depths (h, w)."""
        total = np.zeros(z_m.shape, np.float32)
        for own, profile in zip(self.pixels, self.profiles, strict=True):
            total += own * np.interp(z_m, self.z_m, profile)
        return total


def reported(z_true_m: FloatArray, bias: DepthBias, field: SensorField | None) -> FloatArray:
    """Reported depth (h, w), metres, of a sensor with this bias and field, for true depths (h, w)."""
    z_m = np.array(z_true_m, float)
    for _ in range(_ROUNDS):
        error = bias.error_m(z_m)
        z_m = z_true_m - (error if field is None else error + field.error_m(z_m))
    return z_m


def structured_light(width: int, height: int, rms_m: float, rng: np.random.Generator) -> SensorField:
    """A structured-light field with this RMS over the image and 0.8 to 3 m, up to the variation between devices."""
    u, v, x, y = nodes(width, height)
    pattern = waves(x, y, 2, _LENGTHS, rng) + 1.5 * rings(x, y, rng) + 0.08 * bands(x, rng) + 0.12 * cells(x, y, rng)
    disparity = (_KINECT_C0 - 1 / _RANGE_M) / -_KINECT_C1
    profile = _RANGE_M**2 * np.exp(-_ALPHA * (disparity - disparity[0]))
    return rated(SensorField(u, v, _RANGE_M, (pattern - pattern.mean())[None], profile[None]), rms_m, rng)


def stereo(width: int, height: int, rms_m: float, rng: np.random.Generator) -> SensorField:
    """A stereo field: rectification error of two lenses, in disparity."""
    u, v, x, y = nodes(width, height)
    pattern = waves(x, y, 2, _LENGTHS, rng) + 1.5 * rings(x, y, rng)
    field = SensorField(u, v, _RANGE_M, (pattern - pattern.mean())[None], (_RANGE_M**2)[None])
    return rated(field, rms_m, rng)


def rated(field: SensorField, rms_m: float, rng: np.random.Generator) -> SensorField:
    """The field scaled to this RMS over the image and 0.8 to 3 m, up to the variation between devices."""
    along = np.array([np.interp(_RATED_M, field.z_m, profile) for profile in field.profiles])
    values = np.einsum("kab,kc->abc", field.maps, along)
    wanted = rms_m * np.exp(rng.normal(0, _SPREAD))
    scaled = field.maps * (wanted / np.sqrt(np.mean(values**2)))
    return SensorField(field.u_px, field.v_px, field.z_m, scaled, field.profiles)


def nodes(
    width: int, height: int, counts: tuple[int, int] = _NODES
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Nodes u (a,) and v (b,), px, and their coordinates x, y (a, b) from the image centre in half widths."""
    u, v = np.linspace(0, width - 1, counts[0]), np.linspace(0, height - 1, counts[1])
    x, y = np.meshgrid((2 * u - (width - 1)) / width, (2 * v - (height - 1)) / width, indexing="ij")
    return u, v, x, y


def waves(x: FloatArray, y: FloatArray, n: int, lengths: tuple[float, float], rng: np.random.Generator) -> FloatArray:
    """Sum of `n` plane waves of unit amplitude; wavelengths in half widths."""
    total = np.zeros_like(x)
    for _ in range(n):
        way, phase = rng.uniform(0, 2 * np.pi, 2)
        total += np.sin(2 * np.pi * (x * np.cos(way) + y * np.sin(way)) / rng.uniform(*lengths) + phase)
    return total


def rings(x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Concentric rings around the lens axis, growing towards the border like vignetting."""
    r = np.hypot(x - rng.normal(0, 0.08), y - rng.normal(0, 0.08))
    return np.asarray(r * np.cos(2 * np.pi * r / rng.uniform(1.0, 1.8) + rng.uniform(0, 2 * np.pi)))


def bands(x: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Bands of columns with constant offsets and steps between them."""
    edges = np.sort(rng.uniform(-1, 1, 7))
    return np.asarray(rng.normal(0, 1, 8)[np.searchsorted(edges, x)])


def cells(x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """3 x 3 cells with constant offsets and soft edges (repeated projector pattern)."""
    coarse = np.repeat(np.repeat(rng.normal(0, 1, (3, 3)), x.shape[0] // 3 + 1, axis=0), x.shape[1] // 3 + 1, axis=1)
    soft = cv2.GaussianBlur(coarse, (0, 0), 1.2, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(soft[: x.shape[0], : x.shape[1]])

"""What the depth bias does not follow along the range: polynomials up to the fifth degree, in proportion to the depth."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.polynomial import legendre

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Fault
from rgbd_calib.rig.blocks.depth_error import LinearDepthErrorBlock

DEGREE = 5


class DepthRange(LinearDepthErrorBlock):
    """Coefficients of Legendre polynomials of the second degree on, over the camera's depths."""

    name = "depth range"
    held = Fault(
        "depth over the range",
        lambda t: f"{t.camera}'s depth deviates with the distance in a way that its bias does not follow, {t.mm} RMS",
        "Record walls at more distances, over the whole range; check that the depth is not clipped, and say `kind: "
        "time_of_flight` in the camera's depth block of dataset.yaml if it is that",
    )

    @property
    def parameters(self) -> tuple[str, ...]:
        return tuple(f"depth range {k}" for k in range(2, DEGREE + 1))

    @cached_property
    def range_m(self) -> FloatArray:
        """(C, 2)."""
        obs, out = self.setup.obs, []
        for c in range(self.sets):
            z = obs.depth_m[(obs.camera == c)[:, None] & obs.has_depth]
            out.append((z.min(), max(z.max(), z.min() + 1e-6)) if len(z) else (0.0, 1.0))
        return np.array(out)

    def basis(self, camera: int, pixels_px: FloatArray, depth_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        low, high = self.range_m[camera]
        inside = (depth_m >= low) & (depth_m <= high)
        by_t = legendre.legder(np.eye(DEGREE + 1)[:, 2:])  # (DEGREE, n): derivatives of the shapes as series
        t, z = self._over_range(camera, depth_m), depth_m[..., None]
        shapes = legendre.legvander(t, DEGREE)[..., 2:]
        slopes = np.moveaxis(legendre.legval(t, by_t), 0, -1) * (2 / (high - low)) * inside[..., None]
        return shapes * z, shapes + slopes * z

    def _over_range(self, camera: int, depth_m: FloatArray) -> FloatArray:
        low, high = self.range_m[camera]
        return np.asarray(np.clip(2 * (depth_m - low) / (high - low) - 1, -1, 1))

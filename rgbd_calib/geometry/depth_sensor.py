"""A depth sensor as a camera of its own: lens, place beside the colour camera, and the error of its depth.

A pixel q_d of the depth image that reports z is the point

    p_color = T_color_depth (z + bias(z) + field(q_d, z)) ray(K_d, q_d)

Depth that a driver has registered to the colour image has the colour camera's lens and place, but for what is wrong with
the registration.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.depth_error import DepthBias, DepthField
from rgbd_calib.geometry.so3 import FloatArray

_ROUNDS = 30


@dataclass(frozen=True)
class DepthCamera:
    """Lens and place of a depth image that is not quite, or not at all, the colour image's."""

    intrinsics: Intrinsics
    T_color_depth: FloatArray = field(default_factory=lambda: np.eye(4))
    """(4, 4), p_color = T_color_depth @ p_depth, metres."""
    covariance: FloatArray | None = None
    """(10, 10) of fx, fy, cx, cy (px) and the left perturbation (rad, m) of T_color_depth, where it is known."""


@dataclass(frozen=True)
class DepthSensor:
    """From pixels and reported depths to points, and back."""

    camera: DepthCamera
    bias: DepthBias | None = None
    field: DepthField | None = None

    def correct(self, pixels_px: FloatArray, z_m: FloatArray) -> FloatArray:
        """True depth (...), metres, along the depth camera's axis, of reported depths (...) at pixels (..., 2)."""
        z_m = np.asarray(z_m, float)
        out = z_m
        if self.bias is not None:
            stretch = np.linalg.norm(self.camera.intrinsics.rays(pixels_px), axis=-1) if self.bias.along_ray else 1.0
            out = self.bias.correct(z_m, stretch)
        return out if self.field is None else out + self.field.error_m(pixels_px, z_m)

    def points(self, pixels_px: FloatArray, z_m: FloatArray) -> FloatArray:
        """Points (n, 3), metres, in the colour camera's frame, of pixels (n, 2) and reported depths (n,)."""
        p_depth = self.camera.intrinsics.unproject(pixels_px, self.correct(pixels_px, z_m))
        return se3.transform(self.camera.T_color_depth, p_depth)

    def report(self, p_color: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What the sensor reports of points (n, 3), metres, in the colour camera's frame: pixels (n, 2), depths (n,).

        The inverse of :meth:`points`, by fixed-point iteration: bias and field are small and smooth.
        """
        p_depth = se3.transform(se3.inverse(self.camera.T_color_depth), p_color)
        pixels, z = self.camera.intrinsics.project(p_depth), p_depth[:, 2]
        reported = np.array(z)
        for _ in range(_ROUNDS):
            step = self.correct(pixels, reported) - z
            reported = reported - step
            if not np.any(np.abs(step) > 1e-12):
                break
        return pixels, reported

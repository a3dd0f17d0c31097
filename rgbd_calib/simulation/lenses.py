"""Rational and fisheye lenses of colour cameras, and lenses and poses of depth cameras.

Coefficients are those of real devices up to a few per cent: Azure Kinect (rational; depth in its narrow field of view), Kinect v2
(512 x 424 px; OpenKinect: fx 365.456, k1 0.0905, k2 -0.2682, k3 0.0951), Kinect v1 (640 x 480 px).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics, LensKind
from rgbd_calib.simulation.realism import Realism
from rgbd_calib.types import DepthCamera

_RATIONAL_COLOR = (0.51, -2.65, 0.0006, -0.0003, 1.55, 0.39, -2.47, 1.48)
_RATIONAL_DEPTH = (5.26, 3.58, 0.0, 0.0, 0.189, 5.59, 5.21, 1.01)
_FISHEYE = (0.02, -0.012, 0.004, -0.001)
_DEPTH_LENSES: dict[tuple[int, int], tuple[float, tuple[float, ...]]] = {
    (512, 424): (365.5, (0.0905, -0.2682, 0.0, 0.0, 0.0951)),
    (640, 576): (504.3, _RATIONAL_DEPTH),
    (640, 480): (585.0, (-0.09, 0.31, 0.0, 0.0, -0.2)),
}
"""Focal length and coefficients by image size: Kinect v2, Azure Kinect, Kinect v1."""
DEPTH_SIZES = tuple(_DEPTH_LENSES)
_BASELINE_M = 0.052
"""Nominal baseline between colour and depth camera of a Kinect v2."""


def color_lens(kind: LensKind, plain: Intrinsics, rng: np.random.Generator) -> Intrinsics:
    """A lens of this model for the same image size as the given `brown` lens."""
    if kind == "brown":
        return plain
    if kind == "fisheye":
        # about 90 degrees horizontally; a square at 3 m is still 8 px wide
        f = plain.fx * rng.uniform(0.72, 0.76)
        own = np.array(_FISHEYE) * rng.uniform(0.7, 1.3, 4)
        return replace(plain, fx=f, fy=f * plain.fy / plain.fx, distortion=_floats(own), model="kannala_brandt")
    own = np.array(_RATIONAL_COLOR) * rng.uniform(0.97, 1.03)
    own[2:4] += rng.normal(0, 0.0004, 2)
    return replace(plain, distortion=_floats(own))


def depth_camera(size: tuple[int, int], rng: np.random.Generator) -> DepthCamera:
    """Lens and pose of a separate depth camera, 52 mm beside the colour camera and rotated by a degree."""
    focal, coefficients = _DEPTH_LENSES[size]
    f = focal * (1 + rng.normal(0, 0.004))
    cx, cy = ((side - 1) / 2 + rng.normal(0, 3.0) for side in size)
    own = np.array(coefficients) * rng.uniform(0.97, 1.03)
    own[2:4] += rng.normal(0, 0.0003, 2)
    lens = Intrinsics(*size, f, f * (1 + rng.normal(0, 0.001)), cx, cy, _floats(own))
    turn, move = rng.normal(0, np.radians(0.6), 3), rng.normal(0, 0.0015, 3) + [_BASELINE_M, 0, 0]
    return DepthCamera(lens, se3.make(so3.exp(turn), move))


def factory_calibration(camera: DepthCamera, realism: Realism, rng: np.random.Generator) -> DepthCamera:
    """The depth camera as its factory calibration states it."""
    lens = camera.intrinsics
    stated = replace(
        lens,
        fx=lens.fx * (1 + rng.normal(0, realism.factory_focal)),
        fy=lens.fy * (1 + rng.normal(0, realism.factory_focal)),
        cx=lens.cx + rng.normal(0, realism.factory_centre_px),
        cy=lens.cy + rng.normal(0, realism.factory_centre_px),
    )
    xi = np.concatenate([rng.normal(0, realism.factory_turn_rad, 3), rng.normal(0, realism.factory_move_m, 3)])
    return DepthCamera(stated, se3.retract(camera.T_color_depth, xi))


def _floats(values: np.ndarray) -> tuple[float, ...]:
    return tuple(float(v) for v in values)

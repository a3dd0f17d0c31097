"""True rigs: cameras on an arc or in a ring that look into the room, each with its own lens and depth bias."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics, LensKind
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.depth_field import SensorField, stereo, structured_light
from rgbd_calib.simulation.lenses import color_lens, depth_camera, factory_calibration
from rgbd_calib.simulation.realism import Realism
from rgbd_calib.simulation.time_of_flight import nodes_px, time_of_flight_field
from rgbd_calib.types import DepthBias, DepthCamera, RigCamera

Layout = Literal["arc", "ring"]
Sensor = Literal["structured-light", "tof", "stereo"]

_RADIUS_M = 2.35
_CENTRE_M = np.array([-0.1, 0.05, 0.0])
_TARGET_HEIGHT_M = 1.05
_MAX_STEP_RAD, _MAX_ARC_RAD = np.radians(34.0), np.radians(115.0)
_TIME_OF_FLIGHT = 0.6
"""Magnitude of its field relative to structured light."""
_WARMS_UP = 0.3
"""Time constant of the temperature drift as a share of the session: ten minutes of thirty."""
_FOCUS_M = (1.2, 2.4)
BIAS_RANGE_M = (0.5, 5.0)


@dataclass(frozen=True)
class TrueRig:
    """What the simulation knows of a rig; the world is the first camera."""

    intrinsics: dict[str, Intrinsics]
    T_room_color: dict[str, FloatArray]
    depth_bias: dict[str, DepthBias]
    depth_field: dict[str, SensorField] = field(default_factory=dict)
    """Depth error over the image; cameras without one are absent."""
    depth_camera: dict[str, DepthCamera] = field(default_factory=dict)
    """Geometry of depth images that differs from the colour images'."""
    stated_depth: dict[str, DepthCamera] = field(default_factory=dict)
    """Factory calibration of unregistered depth cameras."""
    cold_m: dict[str, float] = field(default_factory=dict)
    """Range error at the start of the session."""
    focus_m: dict[str, float] = field(default_factory=dict)
    """Focus distance; absent: sharp everywhere."""

    @property
    def cameras(self) -> tuple[str, ...]:
        return tuple(self.intrinsics)

    @property
    def T_world_room(self) -> FloatArray:
        """(4, 4): the world is the frame of the first camera."""
        return se3.inverse(self.T_room_color[self.cameras[0]])

    @property
    def T_world_color(self) -> dict[str, FloatArray]:
        """(4, 4) by camera; exactly the identity for the first."""
        first, *others = self.cameras
        return {first: np.eye(4)} | {c: self.T_world_room @ self.T_room_color[c] for c in others}

    def drift_m(self, camera: str, warm: float) -> float:
        """Temperature drift of ranges after a share `warm` of the session; the bias is that of the warm device."""
        return self.cold_m.get(camera, 0.0) * float(np.exp(-warm / _WARMS_UP))

    @property
    def rig_cameras(self) -> dict[str, RigCamera]:
        """The cameras in the form of a rig file."""
        return {
            c: RigCamera(
                self.intrinsics[c],
                T,
                np.zeros((6, 6)),
                self.depth_bias[c],
                depth_field=self.depth_field[c].grid if c in self.depth_field else None,
                depth_camera=self.depth_camera.get(c),
            )
            for c, T in self.T_world_color.items()
        }


def look_at(position_m: FloatArray, target_m: FloatArray, roll_rad: float = 0.0) -> FloatArray:
    """T_room_color (4, 4) of a camera at `position_m` (3,) that looks at `target_m` (3,), upright but for the roll."""
    forward = np.asarray(target_m, float) - position_m
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward], axis=1)
    return se3.make(R @ so3.exp(np.array([0.0, 0.0, roll_rad])), np.asarray(position_m, float))


def true_rig(n_cameras: int, layout: Layout, width: int, height: int, rng: np.random.Generator) -> TrueRig:
    """A rig of cameras C1, C2, ... with the errors that real ones have."""
    names = [f"C{i + 1}" for i in range(n_cameras)]
    if layout == "ring":
        angles = 2 * np.pi * np.arange(n_cameras) / n_cameras
    else:
        span = min(_MAX_STEP_RAD * (n_cameras - 1), _MAX_ARC_RAD)
        angles = np.linspace(-span / 2, span / 2, n_cameras)
    angles = angles - np.pi / 2 + np.radians(rng.uniform(-2, 2, n_cameras))
    intrinsics, poses, biases = {}, {}, {}
    for name, angle in zip(names, angles, strict=True):
        radius = _RADIUS_M + rng.uniform(-0.1, 0.1)
        position = _CENTRE_M + [radius * np.cos(angle), radius * np.sin(angle), 1.6 + rng.uniform(-0.15, 0.25)]
        target = _CENTRE_M + [*rng.uniform(-0.15, 0.15, 2), _TARGET_HEIGHT_M + rng.uniform(-0.08, 0.08)]
        intrinsics[name] = true_intrinsics(width, height, rng)
        poses[name] = look_at(position, target, np.radians(rng.uniform(-3, 3)))
        biases[name] = true_depth_bias(rng)
    return TrueRig(intrinsics, poses, biases)


def true_intrinsics(width: int, height: int, rng: np.random.Generator) -> Intrinsics:
    """A colour camera of about 60 x 47 degrees, as in an Xtion: 525-580 px at 640 x 480."""
    scale = width / 640
    fx = rng.uniform(527, 578)
    fy = fx * (1 + rng.uniform(-0.003, 0.003))
    cx, cy = (width - 1) / 2 + scale * rng.uniform(-9, 9), (height - 1) / 2 + scale * rng.uniform(-7, 7)
    k1, k2 = rng.uniform(0.03, 0.08), rng.uniform(-0.16, -0.06)
    p1, p2 = rng.uniform(-0.0015, 0.0015, 2)
    return Intrinsics(width, height, scale * fx, scale * fy, cx, cy, (k1, k2, float(p1), float(p2), 0.0))


def true_depth_bias(rng: np.random.Generator) -> DepthBias:
    """A quadratic through three errors: some mm at 0.8 m, up to 1 cm at 1.8 m, 1-3 cm at 3 m."""
    far_m = rng.choice([-1.0, 1.0]) * rng.uniform(0.010, 0.030)
    errors_m = np.array([rng.uniform(-0.004, 0.004), 0.3 * far_m + rng.uniform(-0.003, 0.003), far_m])
    c = np.linalg.solve(np.vander([0.8, 1.8, 3.0], 3, increasing=True), errors_m)
    return DepthBias(tuple(float(v) for v in c), *BIAS_RANGE_M, rms_m=0.0)


def no_depth_bias() -> DepthBias:
    return DepthBias((0.0,), *BIAS_RANGE_M, rms_m=0.0)


def with_lenses(rig: TrueRig, kinds: Sequence[LensKind], rng: np.random.Generator) -> TrueRig:
    """The rig with colour lenses of these models, in turn."""
    lenses = {c: color_lens(kinds[i % len(kinds)], lens, rng) for i, (c, lens) in enumerate(rig.intrinsics.items())}
    return replace(rig, intrinsics=lenses)


def with_errors(
    rig: TrueRig, sensor: Sensor, depth_size: tuple[int, int] | None, realism: Realism, rng: np.random.Generator
) -> TrueRig:
    """The rig with depth fields, registration errors, drift and focus.

    With a `depth_size`, depth is not registered to colour but has a camera of its own.
    """
    fields, cameras, stated, cold_m, focus_m = {}, {}, {}, {}, {}
    for name, lens in rig.intrinsics.items():
        of_field, of_registration, of_drift, of_focus = rng.spawn(4)
        if depth_size is not None:
            cameras[name] = depth_camera(depth_size, of_registration)
            stated[name] = factory_calibration(cameras[name], realism, of_registration)
        elif realism.has("registration"):
            cameras[name] = misregistered(lens, realism, of_registration)
        if realism.has("depth_field"):
            fields[name] = _field(sensor, cameras[name].intrinsics if name in cameras else lens, realism, of_field)
        if sensor == "tof" and realism.has("drift"):
            cold_m[name] = float(of_drift.normal(0, realism.drift_m))
        if realism.has("images"):
            focus_m[name] = float(of_focus.uniform(*_FOCUS_M))
    return replace(rig, depth_field=fields, depth_camera=cameras, stated_depth=stated, cold_m=cold_m, focus_m=focus_m)


def _field(sensor: Sensor, lens: Intrinsics, realism: Realism, rng: np.random.Generator) -> SensorField:
    if sensor == "tof":
        length = np.linalg.norm(lens.rays(nodes_px(lens.width, lens.height)), axis=-1)
        return time_of_flight_field(lens.width, lens.height, length, _TIME_OF_FLIGHT * realism.field_m, rng)
    draw = stereo if sensor == "stereo" else structured_light
    return draw(lens.width, lens.height, realism.field_m, rng)


def misregistered(lens: Intrinsics, realism: Realism, rng: np.random.Generator) -> DepthCamera:
    """Registered depth for a colour image with this lens, with the registration error of a factory calibration."""
    way, far_px = rng.uniform(0, 2 * np.pi), realism.registration_px * rng.uniform(2 / 3, 4 / 3) * lens.width / 640
    scale = 1 + rng.normal(0, realism.registration_scale)
    seen = replace(
        lens,
        fx=lens.fx * scale,
        fy=lens.fy * scale,
        cx=lens.cx + far_px * np.cos(way),
        cy=lens.cy + far_px * np.sin(way),
    )
    turn, move = rng.normal(0, realism.registration_turn_rad, 3), rng.normal(0, realism.registration_move_m, 3)
    return DepthCamera(seen, se3.make(so3.exp(turn), move))

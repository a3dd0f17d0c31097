"""Light in the room: a lamp, a window, and what comes from all around."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.scene import Caster

_AMBIENT = np.array([0.44, 0.43, 0.42])
_BOUNCE_FAR_M = 0.9
"""Surfaces nearer than this take away light from all around."""


@dataclass(frozen=True)
class Light:
    """A rectangle that gives light: a lamp under the ceiling, a window."""

    corner_m: FloatArray
    u_m: FloatArray
    v_m: FloatArray
    normal: FloatArray
    power: FloatArray
    """(3,) RGB: irradiance is power cos cos' / distance^2, metres."""


LIGHTS = (
    Light(np.array([-1.0, -0.6, 2.655]), np.array([2.0, 0, 0]), np.array([0, 1.2, 0]), np.array([0, 0, -1.0]),
          np.array([3.3, 3.12, 2.8])),
    Light(np.array([3.37, 0.15, 0.95]), np.array([0, 1.7, 0]), np.array([0, 0, 1.35]), np.array([-1.0, 0, 0]),
          np.array([3.0, 3.4, 3.9])),
)  # fmt: skip


@dataclass(frozen=True)
class InstantLight:
    """Illumination of one frame relative to the lamps, non-uniform over the room."""

    level: float
    slope: float
    per_m: FloatArray
    """(3,) wave vector of the non-uniformity, cycles per metre, horizontal."""
    phase_rad: float

    def at(self, points_m: FloatArray) -> FloatArray:
        """Factor (...) at points (..., 3), metres, in the room."""
        return np.asarray(self.level * (1 + self.slope * np.sin(2 * np.pi * points_m @ self.per_m + self.phase_rad)))


def instant_light(change: float, slope: float, rng: np.random.Generator) -> InstantLight:
    """Draw the illumination of a frame (clouds, people in front of lamps) with these relative magnitudes."""
    way, phase = rng.uniform(0, 2 * np.pi, 2)
    wave = np.array([np.cos(way), np.sin(way), 0.0]) / rng.uniform(2.0, 5.0)
    return InstantLight(float(np.exp(rng.normal(0, change))), float(abs(rng.normal(0, slope))), wave, float(phase))


def unshadowed(normals: FloatArray, points_m: FloatArray) -> FloatArray:
    """Light (n, 3) on points (n, 3) where nothing throws shadows."""
    light = _AMBIENT * (0.75 + 0.25 * normals[:, 2:])
    for lamp in LIGHTS:
        light += _from_lamp(lamp, np.array([[0.5, 0.5]]), points_m, normals)[0][:, None] * lamp.power
    return light


def shadowed_irradiance(
    normals: FloatArray, points_m: FloatArray, caster: Caster, spread: list[FloatArray]
) -> FloatArray:
    """Light (n, 3) on points (n, 3); `spread`, 1 + lights arrays (n, 2) in [0, 1), chooses a direction into the room
    and a place on each light for each point."""
    lifted = points_m + 2e-3 * normals
    light = _AMBIENT * (0.75 + 0.25 * normals[:, 2:]) * _openness(lifted, normals, caster, spread[0])[:, None]
    for lamp, places in zip(LIGHTS, spread[1:], strict=True):
        share, to_lamp = _from_lamp(lamp, places, lifted, normals)
        lit = np.flatnonzero(share > 0)
        share[lit[caster.blocked(lifted[lit], to_lamp[lit], 0.98)]] = 0
        light += share[:, None] * lamp.power
    return light


def _from_lamp(
    lamp: Light, places: FloatArray, points_m: FloatArray, normals: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Irradiance (n,) for a power of one from `places` (n or 1, 2) on a light, and the way there (n, 3), metres."""
    to_lamp = lamp.corner_m + places[:, :1] * lamp.u_m + places[:, 1:] * lamp.v_m - points_m
    r2 = np.einsum("ij,ij->i", to_lamp, to_lamp)
    cosines = np.maximum(np.einsum("ij,ij->i", to_lamp, normals), 0) * np.maximum(-to_lamp @ lamp.normal, 0)
    return cosines / (r2 * np.maximum(r2, 0.3)), to_lamp


def _openness(lifted_m: FloatArray, normals: FloatArray, caster: Caster, spread: FloatArray) -> FloatArray:
    """Share (n,) of the light from all around that is not taken away by things near by: one ray for each point."""
    # a direction on the sphere, added to the normal: density by the cosine
    z, turn = 2 * spread[:, 0] - 1, 2 * np.pi * spread[:, 1]
    r = np.sqrt(1 - z * z)
    direction = normals * 1.001 + np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.where(caster.blocked(lifted_m, direction, _BOUNCE_FAR_M), 0.25, 1.0)

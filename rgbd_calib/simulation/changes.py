"""What happens to an empty scene between two snapshots: cameras bumped, furniture moved, people, light, warm depth.

The cameras' motions are twists in their own frames, T_old_new = exp(twist): p_old = T_old_new p_new for the points of a
scene that stood still, p in the camera's frame before and after.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.room import BLACK, FLOOR, WALL, furnished_with, furniture
from rgbd_calib.simulation.scene import Scene, cone, join, quad, rod
from rgbd_calib.simulation.textures import Material, hex_color, plain

Surroundings = Literal["room", "wall", "floor"]

_STANDING_M = 1.1
"""Half the side of the square about the room's middle in which people stand: where a rig looks."""
_MOVED_M, _TURNED_RAD = (0.15, 0.6), np.radians(30.0)
_SKIN = plain("skin", "c99a7c")
_CLOTHES = ("35506b", "7a3b3b", "4d5b3a", "6b6b72", "b8a06a", "2e2e34")


@dataclass(frozen=True)
class SceneChange:
    """What differs between the old and the new snapshot."""

    twists: Mapping[str, FloatArray] = field(default_factory=dict)
    """(6,) rotation vector (rad) and translation (m) by camera, in its own frame; cameras that stayed are absent."""
    objects: int = 0
    """Pieces of furniture moved by 15 to 60 cm and turned."""
    people: int = 0
    """People standing in the new snapshot."""
    light: float = 1.0
    """Illumination of the new snapshot relative to the old."""
    depth_scale: float = 0.0
    """Warm-up: relative change of the measured depth."""
    depth_offset_m: float = 0.0
    surroundings: Surroundings = "room"
    """"wall": nothing but a painted wall, "floor": nothing but planks."""

    def T_old_new(self, camera: str) -> FloatArray:
        """(4, 4)."""
        return se3.retract(np.eye(4), np.asarray(self.twists.get(camera, np.zeros(6)), float))


def scenes(change: SceneChange, rng: np.random.Generator) -> tuple[Scene, Scene]:
    """The scene of the old and of the new snapshot, in the room's frame."""
    if change.surroundings != "room":
        flat = _FLAT[change.surroundings]
        return flat, flat
    pieces = list(furniture())
    old = furnished_with(pieces)
    for i in rng.choice(len(pieces), min(change.objects, len(pieces)), replace=False):
        pieces[i] = _pushed(pieces[i], rng)
    standing = [_person(rng) for _ in range(change.people)]
    return old, furnished_with([*pieces, *standing])


_FLAT = {
    "wall": quad([-12.0, 0.3, -12.0], [24.0, 0, 0], [0, 0, 24.0], WALL),
    "floor": quad([-12.0, -12.0, 0.0], [24.0, 0, 0], [0, 24.0, 0], FLOOR),
}


def _pushed(piece: Scene, rng: np.random.Generator) -> Scene:
    """The same thing pushed over the floor and turned about its middle."""
    middle = (piece.corners_m + (piece.edges_u_m + piece.edges_v_m) / 2).mean(axis=0)
    way = rng.uniform(0, 2 * np.pi)
    shift_m = rng.uniform(*_MOVED_M) * np.array([np.cos(way), np.sin(way), 0.0])
    R = so3.exp(np.array([0.0, 0.0, rng.uniform(-_TURNED_RAD, _TURNED_RAD)]))
    return piece.moved(se3.make(R, middle + shift_m - R @ middle))


def _person(rng: np.random.Generator) -> Scene:
    """Somebody of 1.6 to 1.9 m, standing."""
    x, y = rng.uniform(-_STANDING_M, _STANDING_M, 2)
    height = rng.uniform(1.6, 1.9)
    shirt, trousers = (_cloth(code) for code in rng.choice(_CLOTHES, 2, replace=False))
    way = rng.uniform(0, 2 * np.pi)
    right = np.array([np.cos(way), np.sin(way), 0.0])
    at = np.array([x, y, 0.0])

    def up(share: float, aside_m: float = 0.0) -> FloatArray:
        place: FloatArray = at + aside_m * right + np.array([0, 0, share * height])
        return place

    legs = [cone(up(0.0, a), up(0.48, a), 0.065, 0.09, trousers) for a in (-0.1, 0.1)]
    arms = [rod(up(0.45, 1.25 * a), up(0.8, a), 0.05, shirt) for a in (-0.23, 0.23)]
    body = cone(up(0.46), up(0.83), 0.16, 0.2, shirt)
    shoulders = cone(up(0.83), up(0.87), 0.2, 0.06, shirt)
    head = [cone(up(0.86), up(0.93), 0.06, 0.1, _SKIN), cone(up(0.93), up(1.0), 0.1, 0.05, BLACK)]
    return join([*legs, *arms, body, shoulders, *head])


def _cloth(code: str) -> Material:
    return Material(f"cloth {code}", "fabric", (hex_color(code),), 0.1)

"""Scenes as plain data: textured rectangles, in metres, and a ray caster for them.

Everything - walls, furniture, the board, round legs - is made of rectangles, so that a hit is a rectangle's number
and two coordinates in metres on it, which is all that the procedural textures need. Lengths along a ray are in
multiples of its direction: with directions of z = 1 in a camera's frame they are the depth z.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.textures import Material

IntArray = np.ndarray
BoolArray = np.ndarray


@dataclass(frozen=True)
class Scene:
    """Rectangles ``corner + s u + t v``, 0 <= s, t <= 1, in one frame."""

    corners_m: FloatArray
    """(n, 3)."""
    edges_u_m: FloatArray
    """(n, 3)."""
    edges_v_m: FloatArray
    """(n, 3), at right angles to `edges_u_m` (nearly, on round things)."""
    material: IntArray
    """(n,) index into `materials`."""
    materials: tuple[Material, ...]

    def moved(self, T_a_b: FloatArray) -> Scene:
        """The same things with coordinates in frame a instead of b."""
        R = T_a_b[:3, :3]
        return replace(
            self,
            corners_m=se3.transform(T_a_b, self.corners_m),
            edges_u_m=self.edges_u_m @ R.T,
            edges_v_m=self.edges_v_m @ R.T,
        )

    def quads_of(self, material_name: str) -> IntArray:
        """Numbers of the rectangles of one material."""
        return np.flatnonzero([self.materials[m].name == material_name for m in self.material])

    @property
    def normals(self) -> FloatArray:
        """Unit normals (n, 3), of either sign."""
        n = np.cross(self.edges_u_m, self.edges_v_m)
        return n / np.linalg.norm(n, axis=1, keepdims=True)


def join(scenes: Iterable[Scene]) -> Scene:
    """One scene of several in the same frame; the first's rectangles keep their numbers."""
    scenes = list(scenes)
    materials = tuple(dict.fromkeys(m for s in scenes for m in s.materials))
    number = {m: i for i, m in enumerate(materials)}
    return Scene(
        np.concatenate([s.corners_m for s in scenes]),
        np.concatenate([s.edges_u_m for s in scenes]),
        np.concatenate([s.edges_v_m for s in scenes]),
        np.concatenate([np.array([number[s.materials[m]] for m in s.material], int) for s in scenes]),
        materials,
    )


def quad(corner_m: ArrayLike, u_m: ArrayLike, v_m: ArrayLike, material: Material) -> Scene:
    """One rectangle."""
    corner, u, v = (np.asarray(a, float).reshape(1, 3) for a in (corner_m, u_m, v_m))
    return Scene(corner, u, v, np.zeros(1, int), (material,))


def box(low_m: ArrayLike, high_m: ArrayLike, material: Material) -> Scene:
    """A block between two opposite corners, edges along the axes; textures run along the longer edge of each face."""
    low, high = np.asarray(low_m, float), np.asarray(high_m, float)
    x, y, z = np.diag(high - low)
    faces = [(low, x, y), (low + z, x, y), (low, x, z), (low + y, x, z), (low, y, z), (low + x, y, z)]
    turned = [(c, u, v) if np.linalg.norm(u) >= np.linalg.norm(v) else (c, v, u) for c, u, v in faces]
    return join(quad(c, u, v, material) for c, u, v in turned)


def rod(bottom_m: ArrayLike, top_m: ArrayLike, radius_m: float, material: Material, sides: int = 10) -> Scene:
    """A round rod between two points, without end caps."""
    return cone(bottom_m, top_m, radius_m, radius_m, material, sides)


def cone(
    bottom_m: ArrayLike, top_m: ArrayLike, radius_m: float, top_radius_m: float, material: Material, sides: int = 12
) -> Scene:
    """A rod that widens or narrows (lamp shades, flower pots), without end caps; its faces are parallelograms
    that overlap a little where it narrows."""
    bottom, top = np.asarray(bottom_m, float), np.asarray(top_m, float)
    axis = (top - bottom) / np.linalg.norm(top - bottom)
    a = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    a /= np.linalg.norm(a)
    b = np.cross(axis, a)
    angles = 2 * np.pi * np.arange(sides + 1) / sides
    ring = np.cos(angles)[:, None] * a + np.sin(angles)[:, None] * b
    low, high = bottom + radius_m * ring, top + top_radius_m * ring
    if top_radius_m > radius_m:  # the wide end sets the width, so that no gaps open
        low, high = high, low
    return join(quad(low[i], low[i + 1] - low[i], high[i] - low[i], material) for i in range(sides))


@dataclass(frozen=True)
class Hits:
    """Where rays (n) end."""

    quad: IntArray
    """(n,) number of the rectangle, -1 for nothing."""
    t: FloatArray
    """(n,) length in multiples of the ray's direction, inf for nothing."""


class Caster:
    """Rays against a scene, on one thread (Open3D's RaycastingScene, that is Embree)."""

    def __init__(self, scene: Scene) -> None:
        import open3d as o3d

        self.scene = scene
        self._tensor = cast(Any, o3d.core.Tensor)
        self._open3d: Any = o3d.t.geometry.RaycastingScene(nthreads=1)
        c, u, v = scene.corners_m, scene.edges_u_m, scene.edges_v_m
        vertices = np.stack([c, c + u, c + u + v, c + v], axis=1).reshape(-1, 3)
        triangles = (4 * np.arange(len(c))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
        self._open3d.add_triangles(self._tensor(vertices.astype(np.float32)), self._tensor(triangles.astype(np.uint32)))
        self._normals = scene.normals
        self._offsets_m = np.einsum("ij,ij->i", self._normals, scene.corners_m)

    def cast(self, origin_m: FloatArray, directions: FloatArray) -> Hits:
        """First rectangles hit by rays from `origin_m` (3,) along `directions` (n, 3)."""
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3], rays[:, 3:] = origin_m, directions
        answer = self._open3d.cast_rays(self._tensor(rays))
        triangle = answer["primitive_ids"].numpy()
        found = np.flatnonzero(np.isfinite(answer["t_hit"].numpy()))
        quad, t = np.full(len(directions), -1), np.full(len(directions), np.inf)
        quad[found] = triangle[found] // 2
        # Embree works in single precision: it says which rectangle, the length is computed again in double
        n = self._normals[quad[found]]
        t[found] = (self._offsets_m[quad[found]] - n @ origin_m) / np.einsum("ij,ij->i", n, directions[found])
        return Hits(quad, t)

    def blocked(self, origins_m: FloatArray, directions: FloatArray, far: float) -> BoolArray:
        """(n,): is anything on ``origin + t direction``, 0 < t < far, for rays (n, 3)?"""
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3], rays[:, 3:] = origins_m, directions
        return self._open3d.test_occlusions(self._tensor(rays), tnear=0.0, tfar=far).numpy()

    def distance_m(self, points_m: FloatArray) -> FloatArray:
        """(n,) metres from points (n, 3) to the nearest surface."""
        return self._open3d.compute_distance(self._tensor(points_m.astype(np.float32)), nthreads=1).numpy()

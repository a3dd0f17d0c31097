"""The small unknowns that few rows depend on: the board's pose of each frame, or, where it is freed, its corners; each wall's plane.

A frame that only one camera sees is posed in that camera, so that it does not tie its intrinsics to its pose. The structure
of frames that several cameras see may be freed: then each corner is a point of its own (the paper's eq. 4.5), in place of the
board's pose; views of one camera alone keep the board, which alone makes them say something.

T_parent_board <- Exp(xi) T_parent_board moves a point of the parent's frame by phi x p + rho.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.linear import BoolArray, IntArray
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.sight import Look


@dataclass(frozen=True)
class Boards:
    """Poses of the boards, or corners of those that are freed; F frames, M corners of a board."""

    T_parent_board: FloatArray
    """(F, 4, 4)."""
    freed: BoolArray
    """(F,) bool: the frame's corners are points of their own; its board's pose stands still and tells the normal."""
    corners_m: FloatArray
    """(F, M, 3), the front's corners in the world, of freed frames; M = 0 where none is."""

    @property
    def size(self) -> int:
        """D, unknowns of one frame: of the board's pose, of which a freed frame uses none, or of its corners."""
        return max(6, 3 * self.corners_m.shape[1])

    def moved(self, step: FloatArray) -> Boards:
        """After a step (F, D)."""
        F, M, _ = self.corners_m.shape
        return Boards(
            se3.retract(self.T_parent_board, np.where(self.freed[:, None], 0.0, step[:, :6])),
            self.freed,
            self.corners_m + step[:, : 3 * M].reshape(F, M, 3) * self.freed[:, None, None],
        )

    def derivative(self, look: Look) -> FloatArray:
        """Of the predicted rows by the frame's unknowns, (n, N, r, D)."""
        assert look.by_point is not None
        freed, obs = look.sight.freed, look.sight.obs
        out = np.zeros((*look.left.shape, self.size))
        out[..., :6] = np.where(freed[:, None, None, None], 0.0, look.by_motion)
        view, n = np.nonzero(freed[:, None] & obs.has_pixel)
        own = 3 * obs.corner[view, n, None] + np.arange(3)
        out[view[:, None], n[:, None], :, own] = look.by_point[view, n].transpose(0, 2, 1)
        return out


N_OF_WALL = 6
"""Unknowns of a wall."""


@dataclass(frozen=True)
class WallPlanes:
    """Where the walls of the bias recording stand, and how they are bent; W walls."""

    values: FloatArray
    """(W, 6): what the written distance D is off by, metres; by how much the tilts a, b of the plane z = D / (1 - a x - b y)
    differ from those of all walls of the camera; and its bend p, q, r, z += D (p x^2 + q x y + r y^2). Walls are not flat, and
    single depth images of them err smoothly by more than the sensor's field, as stray light makes them."""

    @classmethod
    def none(cls, n: int) -> WallPlanes:
        """n walls that are as they are thought to be."""
        return cls(np.zeros((n, N_OF_WALL)))

    def moved(self, step: FloatArray) -> WallPlanes:
        """After a step (W, D), of which the first six are the wall's."""
        return WallPlanes(self.values + step[:, :N_OF_WALL])

    def ahead(
        self, walls: IntArray, distance_m: FloatArray, tilts: FloatArray, rays: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Depth (n, N), metres, at rays (n, N, 2), and its derivative (n, N, 6) by the wall's unknowns."""
        distance, (x, y) = distance_m + self.values[walls, 0], np.moveaxis(rays, -1, 0)
        by_distance = 1 / (1 - np.einsum("nik,nk->ni", rays, tilts + self.values[walls, 1:3]))
        z = distance[:, None] * by_distance
        by_tilts = z[..., None] * by_distance[..., None] * rays
        by_bend = distance_m[:, None, None] * np.stack([x**2, x * y, y**2], axis=-1)
        bent = z + np.einsum("nik,nk->ni", by_bend, self.values[walls, 3:])
        return bent, np.concatenate([by_distance[..., None], by_tilts, by_bend], axis=-1)

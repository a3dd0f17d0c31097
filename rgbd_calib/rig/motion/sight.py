"""Views of a board that moves: what the bundle's rows need, and how fast it all goes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rgbd_calib.geometry.linear import BoolArray
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks import Kind
from rgbd_calib.rig.sight import Look, Sight
from rgbd_calib.rig.terms import LEAST_COS


@dataclass(frozen=True, kw_only=True)
class MovingSight(Sight):
    """Velocities are in the parent's frame; zero where the board stands."""

    velocity: FloatArray
    """(n, N, 3), m/s, of the corners."""
    omega: FloatArray
    """(n, 3), rad/s."""
    age_s: FloatArray
    """(n,), since the camera's first stamp."""
    row: FloatArray
    """(n, N), place of a corner's row in the image, -1/2 to 1/2: how much of the readout it is after the middle row."""
    after_s: FloatArray
    """(n, N), how long after the middle row the corner was exposed; of depth, zero."""
    mid: Sight
    """The same views with all corners at the middle row's instant; of depth, the views of colour."""

    @property
    def moves(self) -> BoolArray:
        """(n,) bool."""
        return np.any(self.velocity != 0, axis=(1, 2))


@dataclass(frozen=True, kw_only=True)
class DelayedLook(Look):
    """Rows of depth that is of another instant than the colour image whose corners say where to read it."""

    seen: MovingSight
    """The same views at the instant of colour."""
    by_seen: FloatArray
    """(n, N, 1, 3), by the point at the instant of colour; `by_point` is the sum of this and of that at the depth's."""

    @property
    def by_later(self) -> FloatArray:
        """(n, N, 1, 3), by the point at the instant of depth."""
        assert self.by_point is not None
        return self.by_point - self.by_seen

    @cached_property
    def motion_seen(self) -> FloatArray:
        """(n, N, 1, 6), by a motion of the colour image's instant."""
        turn = np.cross(self.seen.p_parent[:, :, None], self.by_seen)
        return np.concatenate([turn, self.by_seen], axis=-1)

    @cached_property
    def motion_later(self) -> FloatArray:
        """(n, N, 1, 6), by a motion of the depth image's instant."""
        assert self.by_normal is not None
        turn = np.cross(self.sight.p_parent[:, :, None], self.by_later)
        turn = turn + np.cross(self.sight.R_parent_board[:, None, None, :, 2], self.by_normal)
        return np.concatenate([turn, self.by_later], axis=-1)

    @cached_property
    def by_motion(self) -> FloatArray:
        return self.motion_seen + self.motion_later


def look_at_delayed_depth(sight: Sight, turn: FloatArray, corrected_m: FloatArray, slope: FloatArray) -> DelayedLook:
    """Rows of depth read at the corners' pixels, of the board where it is when depth is taken.

    With n the normal and p a corner at the depth's instant, c = z (x, y, 1) the corner at that of colour, and e the turn by
    registration, the ray of the pixel meets the board at z' = n.p / (n.(x, y, 1) - n_x e_x - n_y e_y), which is
    that of :func:`rgbd_calib.rig.terms.look_at_depth` where p = c.
    """
    assert isinstance(sight, MovingSight) and isinstance(sight.mid, MovingSight)
    seen, p, n = sight.mid, sight.p_color, sight.normal_color[:, None]
    z = seen.p_color[..., 2:]
    ray = seen.p_color / np.where(z > 0, z, 1.0)
    along = np.sum(n[..., :2] * turn, axis=-1)
    distance, down = np.sum(n * p, axis=-1), np.sum(n * ray, axis=-1) - along
    edge_on = np.abs(down) < LEAST_COS
    down = np.where(edge_on, 1.0, down)
    ahead = np.where(edge_on, p[..., 2], distance / down)
    axis = np.array([0.0, 0.0, 1.0])
    by_later = np.where(edge_on[..., None], axis, n / down[..., None])
    by_ray = np.where(edge_on, 0.0, -distance / down**2)[..., None]
    by_seen = by_ray * (n - np.sum(n * ray, axis=-1, keepdims=True) * axis) / np.where(z > 0, z, 1.0)
    ray_now = ray - np.concatenate([turn, np.zeros((*along.shape, 1))], axis=-1)
    by_normal = np.where(edge_on[..., None], 0.0, p / down[..., None] + by_ray * ray_now)
    R, w = sight.R_color_parent, 1 / slope[..., None]
    return DelayedLook(
        Kind.DEPTH,
        sight.camera,
        sight.obs.pixels_px,
        sight.obs.depth_m,
        np.where(sight.obs.has_depth, (ahead - corrected_m) / slope, 0.0)[..., None],
        sight,
        ((by_later + by_seen) * w @ R)[:, :, None],
        by_normal=(by_normal * w @ R)[:, :, None],
        by_turn=-by_ray * n[..., :2] * w,
        slope=slope,
        seen=seen,
        by_seen=(by_seen * w @ R)[:, :, None],
    )


def by_time(look: Look, of_depth_alone: bool = False) -> FloatArray:
    """Derivative (n, N, r) of rows by the instant of what they see, 1/s; zero where the board stands.

    `of_depth_alone`: by that of the depth image, the colour image's being what it is.
    """
    sight = look.sight
    assert look.by_point is not None
    if not isinstance(sight, MovingSight):
        return np.zeros(look.left.shape)
    by_point = look.by_later if isinstance(look, DelayedLook) else look.by_point
    out = np.einsum("nird,nid->nir", by_point, sight.velocity)
    if isinstance(look, DelayedLook) and not of_depth_alone:
        out = out + np.einsum("nird,nid->nir", look.by_seen, look.seen.velocity)
    if look.by_normal is not None:
        turning = np.cross(sight.omega, sight.R_parent_board[..., 2])
        out = out + np.einsum("nird,nd->nir", look.by_normal, turning)
    return out

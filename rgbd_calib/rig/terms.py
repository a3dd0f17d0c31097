"""The terms of the cost: pixels and depth of the board's corners, and the depth of walls.

A view v is one board image of camera l in frame f. With X a corner of the board, p = T_color_parent T_parent_board X,

    r_pixel = (psi(K_l, p) - q) / sigma_2d[l]                                  two for each corner      (eq. 2.3)
    r_depth = (z' - (z + e_l(q, z))) / ((1 + e_l') k_l z^2)                    one, where depth was measured

with z' = [p]_z, or what the depth image shows there if it stands beside its colour (:mod:`.blocks.registration`). A depth pixel
measures z alone: its lateral error is the pixel's, twenty times smaller, so r_depth has one row. A triangulating sensor has
sigma_z = k z^2; k is estimated, and stands for the mean over a corner's cell of median size; how it falls with the cell's
size is estimated too (:mod:`.weights`). The noise is of the reported depth: the correction e scales it by 1 + e', e' its
derivative by z. Against pixels that is nothing; but a board, a rig and a depth that all shrink together would gain by less
noise alone.

A wall at the distance D along the optical axis, tilted by (a, b), shows at the ray (x, y, 1) the depth D / (1 - a x - b y):

    r_wall = (D / (1 - a x - b y) - (z + e_l(q, z))) / ((1 + e_l') k'_l z^2)   one for each cell of its image
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry import camera
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.linear import BoolArray
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Kind
from rgbd_calib.rig.sight import Look, Sight

AHEAD_M = 0.01
"""Corners nearer than this, or behind the camera, have no pixel."""
LEAST_COS = 0.05
"""Between a ray and the board's normal: edge on, depth has no slope."""


def look_at_pixels(sight: Sight, lens: Intrinsics, values: FloatArray) -> Look:
    """Rows of the corners' pixels, by intrinsics `values`, (the longest lens's parameters,)."""
    vector, obs = values[: len(lens.vector)], sight.obs
    p = np.where(obs.has_pixel[..., None], sight.p_color, [0.0, 0.0, 1.0])
    pixels, by_color, by_lens = camera.project_jacobian(vector, p, lens.model)
    padded = np.zeros((*by_lens.shape[:-1], len(values)))
    padded[..., : len(vector)] = by_lens
    by_point = by_color @ sight.R_color_parent[:, None]
    left = np.where(obs.has_pixel[..., None], pixels - obs.pixels_px, 0.0)
    return Look(Kind.PIXEL, sight.camera, obs.pixels_px, obs.depth_m, left, sight, by_point, by_lens=padded)


def look_at_depth(sight: Sight, turn: FloatArray, corrected_m: FloatArray, slope: FloatArray) -> Look:
    """Rows of the corners' depth.

    Parameters
    ----------
    turn : (n, N, 2), of the rays (x, y, 1) of the depth image against those of the colour image.
    corrected_m, slope : (n, N), measured depth as the state corrects it, and its slope by the reported one.
    """
    obs, p, n = sight.obs, sight.p_color, sight.normal_color[:, None]
    z, distance = p[..., 2], np.sum(n * p, axis=-1)
    distance = np.where(np.abs(distance) > LEAST_COS * z, distance, np.inf)
    along = np.sum(n[..., :2] * turn, axis=-1)
    s = z * along / distance
    ahead = z / (1 - s)
    by_s = (z / (1 - s) ** 2)[..., None]
    axis = np.array([0.0, 0.0, 1.0])
    s_by_point = (along / distance)[..., None] * axis - (z * along / distance**2)[..., None] * n
    s_by_normal = np.concatenate([turn, np.zeros((*z.shape, 1))], axis=-1) * (z / distance)[..., None]
    s_by_normal = s_by_normal - (z * along / distance**2)[..., None] * p
    by_point = (axis / (1 - s)[..., None] + by_s * s_by_point) / slope[..., None]
    R = sight.R_color_parent
    return Look(
        Kind.DEPTH,
        sight.camera,
        obs.pixels_px,
        obs.depth_m,
        np.where(obs.has_depth, (ahead - corrected_m) / slope, 0.0)[..., None],
        sight,
        (by_point @ R)[:, :, None],
        by_normal=(by_s * s_by_normal / slope[..., None] @ R)[:, :, None],
        by_turn=by_s * n[..., :2] * (z / distance / slope)[..., None],
        slope=slope,
    )


def look_at_plane(
    sight: Sight, lens: Intrinsics, values: FloatArray, corrected_m: FloatArray, slope: FloatArray
) -> Look:
    """Rows of depth that was read at pixels where no corner was seen: where the pixels' rays meet the board's plane.

    z' = n . p / n . r, with the ray r of the pixel by the intrinsics `values`, (the longest lens's parameters,); a change of
    the lens that moves the ray's own pixel by d turns the ray by -(dpsi/dr)^-1 d.
    """
    obs, p, n = sight.obs, sight.p_color, sight.normal_color[:, None]
    vector = values[: len(lens.vector)]
    rays = lens.with_vector(vector).rays(obs.pixels_px)
    there = obs.has_depth & np.isfinite(rays[..., 0])
    r = np.where(there[..., None], rays, [0.0, 0.0, 1.0])
    _, by_ray, by_lens = camera.project_jacobian(vector, r, lens.model)
    distance, along = np.sum(n * p, axis=-1), np.sum(n * r, axis=-1)
    along = np.where(np.abs(along) > LEAST_COS, along, np.inf)
    ahead = distance / along
    turn = -np.linalg.solve(by_ray[..., :2], by_lens)
    by_own = -(ahead / along)[..., None] * np.einsum(
        "nik,nikp->nip", np.broadcast_to(n[..., :2], r[..., :2].shape), turn
    )
    padded = np.zeros((*ahead.shape, 1, len(values)))
    padded[..., 0, : len(vector)] = by_own / slope[..., None]
    scale = 1 / (along * slope)
    R = sight.R_color_parent
    return Look(
        Kind.DEPTH,
        sight.camera,
        obs.pixels_px,
        obs.depth_m,
        np.where(there, (ahead - corrected_m) / slope, 0.0)[..., None],
        sight,
        (n * scale[..., None] @ R)[:, :, None],
        by_normal=((p - ahead[..., None] * r) * scale[..., None] @ R)[:, :, None],
        by_lens=padded,
        slope=slope,
    )


def look_at_walls(
    c: int, pixels_px: FloatArray, depth_m: FloatArray, ahead_m: FloatArray, by_wall: FloatArray, slope: FloatArray,
    corrected_m: FloatArray, seen: BoolArray,
) -> Look:  # fmt: skip
    """Rows of the cells of walls, (n, N) each; `ahead_m` is where the wall is, `by_wall` (n, N, 6) its derivative by the wall."""
    left = np.where(seen, (ahead_m - corrected_m) / slope, 0.0)
    by_distance, by_tilts = by_wall[..., 0] / slope, by_wall[..., 1:3] / slope[..., None]
    return Look(
        Kind.WALL, c, pixels_px, depth_m, left[..., None], slope=slope, by_distance=by_distance, by_tilts=by_tilts
    )


def pixels_of(sight: Sight, lens: Intrinsics, values: FloatArray) -> FloatArray:
    """Predicted pixels (n, N, 2), without derivatives."""
    p = np.where(sight.obs.has_pixel[..., None], sight.p_color, [0.0, 0.0, 1.0])
    return camera.project(values[: len(lens.vector)], p, lens.model)


def in_front(sight: Sight) -> bool:
    """True where every observed corner lies before its camera."""
    return bool(np.all(sight.p_color[sight.obs.has_pixel][:, 2] > AHEAD_M))

"""The terms of the cost: pixels and depth of the board's corners.

A view v is one board image of camera l in frame f. With X a corner of the board, p = T_color_parent T_parent_board X,

    r_pixel = (psi(K_l, p) - q) / sigma_2d[l]                                  two for each corner      (eq. 2.3)
    r_depth = ([p]_z - (z + e_l(q, z))) / ((1 + e_l') k_l z^2)                 one, where depth was measured

A depth pixel measures z alone: its lateral error is the pixel's, twenty times smaller, so r_depth has one row. A
triangulating sensor has sigma_z = k z^2; k is estimated, and stands for the mean over a corner's cell of median size;
how it falls with the cell's size is estimated too (:mod:`.weights`). The noise is of the reported depth: the correction e
scales it by 1 + e', e' its derivative by z. Against pixels that is nothing; but a board, a rig and a depth that all shrink
together would gain by less noise alone.
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry import camera
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Kind
from rgbd_calib.rig.sight import Look, Sight

AHEAD_M = 0.01
"""Corners nearer than this, or behind the camera, have no pixel."""


def look_at_pixels(sight: Sight, lens: Intrinsics, values: FloatArray) -> Look:
    """What is predicted of the corners' pixels, by intrinsics `values`, (the longest lens's parameters,)."""
    vector = values[: len(lens.vector)]
    p = np.where(sight.obs.has_pixel[..., None], sight.p_color, [0.0, 0.0, 1.0])
    pixels, by_color, by_lens = camera.project_jacobian(vector, p, lens.model)
    padded = np.zeros((*by_lens.shape[:-1], len(values)))
    padded[..., : len(vector)] = by_lens
    by_point = by_color @ sight.R_color_parent[:, None]
    obs = sight.obs
    return Look(Kind.PIXEL, sight.camera, obs.pixels_px, obs.depth_m, pixels, sight, by_point, None, padded)


def look_at_depth(sight: Sight, corrected_m: FloatArray, slope: FloatArray) -> Look:
    """What is predicted of the corners' depth; corrected as the state has it, and its slope by the reported depth, (n, N)."""
    by_point = sight.R_color_parent[:, None, 2:3] / slope[..., None, None]
    obs, z = sight.obs, sight.p_color[..., 2]
    left = (z - corrected_m) / slope
    return Look(
        Kind.DEPTH, sight.camera, obs.pixels_px, obs.depth_m, z[..., None], sight, by_point, slope=slope, left_m=left
    )


def pixels_of(sight: Sight, lens: Intrinsics, values: FloatArray) -> FloatArray:
    """Predicted pixels (n, N, 2), without derivatives."""
    p = np.where(sight.obs.has_pixel[..., None], sight.p_color, [0.0, 0.0, 1.0])
    return camera.project(values[: len(lens.vector)], p, lens.model)


def in_front(sight: Sight) -> bool:
    """True where every observed corner lies before its camera."""
    return bool(np.all(sight.p_color[sight.obs.has_pixel][:, 2] > AHEAD_M))

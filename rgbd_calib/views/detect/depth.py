"""Depth of the board's corners from the depth pixels around them.

A plane has an inverse depth that is affine in the (undistorted) pixel, 1/z = a u + b v + c, and the noise of a
triangulating sensor is constant in 1/z. So the board's pixels are fitted by that plane robustly, pixels off the plane
are dropped, and each corner takes the plane's value at it plus the mean of what the pixels of its own cell (half a
square to each side) deviate: cells are disjoint, so no two corners share a pixel.
"""

from __future__ import annotations

import cv2
import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, IntArray

MIN_CELL_FILL = 0.3
"""A corner has depth where at least this share of its cell's pixels lies on the board's plane."""
MIN_PIXELS = 18
"""Fewer depth pixels than this on the whole board make no plane."""
OUTLIER_SIGMAS = 4.0
PLANE_SAMPLES = 100
NOISE_FLOOR_PER_M = 1e-3
"""The scatter of 1/z about the plane is taken for at least this: 1 mm at 1 m, 4 mm at 2 m. Most pixels of a board may
share one step of the disparity, and their median deviation be zero."""


def corner_depth(
    depth_m: FloatArray, board: Board, ids: IntArray, corners_px: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, IntArray]:
    """Depth (n,), metres, NaN where there is none, and how many pixels each rests on (n,).

    Parameters
    ----------
    depth_m : (h, w), metres, NaN where there is no measurement.
    ids, corners_px : (n,), (n, 2) as :func:`find_corners` returns them.
    """
    n = len(ids)
    nothing = np.full(n, np.nan), np.zeros(n, int)
    cell, u, v, size = _cells(depth_m.shape, board, ids, corners_px)
    q = 1.0 / depth_m[v, u]
    valid = np.isfinite(q)
    if valid.sum() < MIN_PIXELS:
        return nothing
    cell, q = cell[valid], q[valid]
    centre = corners_px.mean(axis=0)  # keeps the plane's normal equations well conditioned
    A = np.column_stack([u[valid] - centre[0], v[valid] - centre[1], np.ones(valid.sum())])
    plane, scale = _least_median(A, q, rng)
    for _ in range(3):
        on_plane = np.abs(q - A @ plane) < OUTLIER_SIGMAS * scale
        plane = np.linalg.lstsq(A[on_plane], q[on_plane], rcond=None)[0]
        scale = float(np.sqrt(np.mean((q - A @ plane)[on_plane] ** 2))) + 1e-12
    residual = np.where(on_plane, q - A @ plane, 0.0)
    count = np.bincount(cell[on_plane], minlength=n)
    deviation = np.bincount(cell, residual, minlength=n) / np.maximum(count, 1)
    at_corner = np.column_stack([corners_px - centre, np.ones(n)]) @ plane + deviation
    good = (count >= np.maximum(MIN_CELL_FILL * size, 3)) & (at_corner > 0)
    return np.where(good, 1.0 / np.where(good, at_corner, 1.0), np.nan), np.where(good, count, 0)


def _cells(
    shape: tuple[int, ...], board: Board, ids: IntArray, corners_px: FloatArray
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Pixels of the corners' cells: row of the corner, u, v (each (m,)), and each cell's size in pixels (n,)."""
    H, _ = cv2.findHomography(corners_px, board.grid[ids])
    H = H * np.sign(H[2] @ [*corners_px[0], 1.0])  # positive on the board's side of the vanishing line
    reach = np.ceil(np.ptp(corners_px, axis=0) / max(min(board.cols, board.rows) - 1, 1) + 2)
    lo = np.maximum(np.floor(corners_px.min(axis=0) - reach), 0).astype(int)
    hi = np.minimum(np.ceil(corners_px.max(axis=0) + reach), [shape[1] - 1, shape[0] - 1]).astype(int)
    u, v = (g.ravel() for g in np.meshgrid(np.arange(lo[0], hi[0] + 1), np.arange(lo[1], hi[1] + 1)))
    on_board = np.column_stack([u, v, np.ones(len(u))]) @ H.T
    x, y = (on_board[:, :2] / on_board[:, 2:]).T
    col, row = _nearest(board.grid[: board.cols, 0], x), _nearest(board.grid[:: board.cols, 1], y)
    row_of = np.full(board.n_corners, -1)
    row_of[ids] = np.arange(len(ids))
    inside = (col >= 0) & (col < board.cols) & (row >= 0) & (row < board.rows) & (on_board[:, 2] > 0)
    cell = np.where(inside, row_of[np.where(inside, row * board.cols + col, 0)], -1)
    keep = cell >= 0
    return cell[keep], u[keep], v[keep], np.bincount(cell[keep], minlength=len(ids))


def _nearest(lines: FloatArray, x: FloatArray) -> IntArray:
    """Which of the lines (n,), in order, is nearest to each x (m,); -1 and n beyond half a square from the outer ones."""
    middles = [lines[0] - 0.5, *(lines[1:] + lines[:-1]) / 2, lines[-1] + 0.5]
    return np.searchsorted(middles, x) - 1


def _least_median(A: FloatArray, q: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, float]:
    """Least median of squares (P. Rousseeuw, 1984): parameters and a robust sigma; up to half may be outliers."""
    thin = rng.choice(len(q), min(len(q), 500), replace=False)
    A, q = A[thin], q[thin]
    triples = rng.integers(len(q), size=(PLANE_SAMPLES, 3))
    usable = np.abs(np.linalg.det(A[triples])) > 1e-3 * np.ptp(A[:, :2])  # the triangle's area, against slivers
    candidates = np.concatenate(
        [
            np.linalg.solve(A[triples][usable], q[triples][usable][..., None])[..., 0],
            [np.linalg.lstsq(A, q, rcond=None)[0]],
        ]
    )
    medians = np.median(np.abs(candidates @ A.T - q), axis=1)
    best = int(np.argmin(medians))
    return candidates[best], max(1.4826 * float(medians[best]), NOISE_FLOOR_PER_M)

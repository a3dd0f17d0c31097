"""A wall in a depth image: its cells, and its distance along the optical axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.linear import BoolArray
from rgbd_calib.geometry.so3 import FloatArray

MIN_VALID_SHARE = 0.2
CENTRE_SHARE = 0.6
"""Width and height of the part of the image that is used: the wall must fill it."""
CLIP_SIGMAS = 4.0


PATCHES = 6
"""Patches along each side, from whose scatter the standard error comes: noise inside a patch may be correlated."""


def depth_at(cells: WallCells, centre_px: tuple[float, float]) -> tuple[float, float]:
    """Depth reported at a pixel and its standard error, metres, by a robust plane through the middle of the image.

    1/z of a plane is affine in the pixel; the fit is repeated without what is far off it. The standard error comes from the
    scatter of patches: noise inside a patch may be correlated. NaN where too few cells are seen.
    """
    rows, columns = cells.seen.shape
    du, dv = round(columns * (1 - CENTRE_SHARE) / 2), round(rows * (1 - CENTRE_SHARE) / 2)
    middle = slice(dv, rows - dv), slice(du, columns - du)
    seen, at, q = cells.seen[middle], cells.pixels_px[middle], 1 / cells.depth_m[middle]
    if seen.mean() < MIN_VALID_SHARE:
        return float("nan"), float("nan")
    v, u = np.indices(seen.shape)
    patch = (PATCHES * v // seen.shape[0]) * PATCHES + PATCHES * u // seen.shape[1]
    patch, at, q = patch[seen], at[seen], q[seen]
    A = np.column_stack([(at - centre_px) / np.abs(cells.pixels_px).max(), np.ones(len(q))])
    keep = np.ones(len(q), bool)
    for _ in range(10):
        plane = np.linalg.lstsq(A[keep], q[keep], rcond=None)[0]
        residual = q - A @ plane
        again = np.abs(residual) < CLIP_SIGMAS * (float(np.std(residual[keep])) + 1e-12)
        if np.array_equal(again, keep):
            break
        keep = again
    count = np.bincount(patch[keep])
    means = np.bincount(patch[keep], residual[keep])[count > 0] / count[count > 0]
    error = np.sqrt(np.sum(means**2) / max(len(means) - 3, 1) / len(means))
    return float(1.0 / plane[2]), float(error / plane[2] ** 2)


@dataclass(frozen=True)
class SeenWall:
    """A wall at a distance that was written down."""

    frame: str
    distance_m: float
    sd_m: float
    cells: WallCells
    tilt: tuple[float, float] = (0.0, 0.0)
    """a, b of its plane z = D / (1 - a x - b y), as it is thought to stand: not zero where the camera is turned against the
    one that the wall is square to."""


CELLS_ACROSS = 40
"""Cells of an image's width: 16 px of 640, finer than what a depth sensor errs by over its image."""
OFF_WALL = 0.05
"""Depth that is farther from the wall's plane, as a share of it, is of something else; sensors err by less."""
MIN_CELL_SHARE = 0.5
"""Of a cell's pixels that must be on the wall."""


@dataclass(frozen=True)
class WallCells:
    """A wall as a depth image shows it, in cells."""

    pixels_px: FloatArray
    """(rows, columns, 2), middles of the cells."""
    depth_m: FloatArray
    """(rows, columns), mean of what was reported; 1 where there is none."""
    seen: BoolArray
    """(rows, columns)."""


def wall_cells(depth_m: FloatArray) -> WallCells:
    """The whole image of a wall; what stands before or beside it is left out.

    Cells have equal sides but for the last of a row or column. 1 / z is averaged: its noise does not depend on z.
    """
    h, w = depth_m.shape
    side = max(round(w / CELLS_ACROSS), 1)
    rows, columns = -(-h // side), -(-w // side)
    with np.errstate(divide="ignore"):
        q = 1.0 / depth_m
    on_wall = np.isfinite(q)
    q = np.where(on_wall, q, 0.0)
    x, y = np.arange(w) / w - 0.5, np.arange(h)[:, None] / h - 0.5
    plane = np.array([0.0, 0.0, float(np.median(q[on_wall]))]) if on_wall.any() else np.zeros(3)
    for tolerance in (0.3, 0.15, OFF_WALL, OFF_WALL):  # from any tilt to the wall's own
        expected = plane[0] * x + (plane[1] * y + plane[2])
        near = on_wall & (np.abs(q - expected) < tolerance * expected)
        if near.sum() < MIN_VALID_SHARE * h * w:
            return _no_cells(rows, columns, side)
        plane = _plane(x, y[:, 0], near.astype(float), np.where(near, q, 0.0))
    v, u = np.mgrid[:h, :w]
    cell, near = ((v // side) * columns + u // side).ravel(), near.ravel()
    size, count = (np.bincount(c, minlength=rows * columns) for c in (cell, cell[near]))
    mean = np.bincount(cell[near], q.ravel()[near], minlength=rows * columns) / np.maximum(count, 1)
    at = np.stack([np.bincount(cell, x.ravel()) / size for x in (u, v)], axis=-1)
    seen = count >= MIN_CELL_SHARE * size
    z = np.where(seen, 1 / np.where(seen, mean, 1.0), 1.0)
    return WallCells(at.reshape(rows, columns, 2), z.reshape(rows, columns), seen.reshape(rows, columns))


def _plane(x: FloatArray, y: FloatArray, w: FloatArray, wq: FloatArray) -> FloatArray:
    """a, b, c of the least squares q = a x + b y + c over an image, from sums along its rows and columns.

    x (columns,), y (rows,), the weights w and the weighted values wq (rows, columns).
    """
    along, down = w.sum(axis=0), w.sum(axis=1)
    xx, yy, xy = along @ x**2, down @ y**2, y @ w @ x
    A = np.array([[xx, xy, along @ x], [xy, yy, down @ y], [along @ x, down @ y, down.sum()]])
    return np.linalg.solve(A, [wq.sum(axis=0) @ x, wq.sum(axis=1) @ y, wq.sum()])


def _no_cells(rows: int, columns: int, side: int) -> WallCells:
    v, u = np.mgrid[:rows, :columns] * side
    nothing = np.zeros((rows, columns), bool)
    return WallCells(np.stack([u, v], axis=-1).astype(float), np.ones((rows, columns)), nothing)

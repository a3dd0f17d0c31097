"""Errors that all views of a camera share, which no noise model has: at one place of the image, and at one depth.

A lens is not quite its polynomial, and a depth sensor not quite its own: it rounds, steps, and ripples over the range. Such
an error is the same for all corners near one pixel, or near one depth, so that filming more does not average it out, and a
covariance that takes the residuals for independent is too small. Here the residuals of each camera are put into cells, of
the image (u and v apart) and of the depth, and one variance is estimated for pixels and one for depth, in units of the
observations' own: r_i = e_i + tau c_k for every weighted residual i of cell k, with e_i and c_k of variance 1.

With W the weight matrix of :mod:`.weights`, a_k the indicator of cell k, s_k = J' W a_k, A = J' W J + prior and
n_kj = a_k' W a_j, the residuals of the fit have r = (1 - H)(e + tau sum_k c_k a_k), H = J A^-1 J' W. Corners beside each other
in one view have more in common: their cells of depth pixels adjoin, their board was not quite where it is put. So only products
of different views count: S_k = a_k' W r is the sum of S_kv of views v, of n_kv corners, and

    E sum_(v != w) S_kv S_kw = f_k (-s_k' A^-1 s_k + tau^2 sum_j (n_kj - s_k' A^-1 s_j)^2),    f_k = 1 - sum_v n_kv^2 / n_k^2,

of which the sum over the cells, each divided by n_kk, is solved for tau^2: the method of moments for a variance component
(C. R. Henderson, Biometrics 9(2), 1953). The second of s_k' A^-1 s_k, the units eliminated, is that of the globals alone, and
f_k takes the corners of a cell for equal. The estimate's covariance grows by tau^2 sum_k A^-1 s_k s_k' A^-1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from rgbd_calib.geometry.linear import BoolArray, Covariance, IntArray, NormalEquations, product
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Kind
from rgbd_calib.rig.observations import Observations
from rgbd_calib.rig.problem import Problem, State

GRID = (8, 6)
"""Cells of the image, across and down: finer than the lens model's own shapes, coarse enough to hold several views."""
RANGE_CELLS = 24
"""Cells of each camera's depths, with equally many corners: some cm wide, several steps of a structured-light sensor."""
DEPTH_GRID = (16, 12)
"""Cells of the image in which depths err alike: finer than the smooth field's shapes."""
N_PIXEL_CELLS = 2 * GRID[0] * GRID[1]
N_CELLS = N_PIXEL_CELLS + RANGE_CELLS + DEPTH_GRID[0] * DEPTH_GRID[1]
MIN_CORNERS = 5
"""Cells with fewer are left out."""


@dataclass(frozen=True)
class CommonErrors:
    pixel: float
    """tau: standard deviation of what a cell's pixels share, in sigmas of one of them."""
    depth: float
    """The same of the depths of a cell of the range."""
    depth_image: FloatArray
    """(C,), the same of the depths of a cell of the image, camera by camera."""
    covariance: FloatArray
    """(P, P) that they add to the global parameters'."""


@dataclass(frozen=True)
class _Sums:
    """Of the weighted residuals in each of K cells; F units of D unknowns, P globals."""

    n: FloatArray
    """(K,), how many."""
    gram: FloatArray
    """(C, cells, cells), a' W a of the cells of each camera."""
    total: FloatArray
    """(K,), a' W r, of the residuals."""
    by_itself: FloatArray
    """(K,), sum of the squares of each view's share of `total`."""
    apart: FloatArray
    """(K,), f_k: share of the pairs of residuals that are of two views."""
    by_global: FloatArray
    """(K, P), a' W J."""
    by_unit: FloatArray
    """(F, K, D)."""


def common_errors(problem: Problem, state: State, cov: Covariance) -> CommonErrors:
    """Estimate what residuals share at the minimum, from its equations."""
    sums = _sums(problem, state, None)
    n, (K, P) = sums.n, sums.by_global.shape
    reduced = _reduced(sums, cov.equations)
    moved = reduced @ cov.of_globals  # A^-1 s_k
    tau = []
    covariance = np.zeros((P, P))
    for mine in _groups(K):
        kept = np.flatnonzero(mine & (n >= MIN_CORNERS))
        by_unit = sums.by_unit[:, kept]
        solved = cov.equations.unit_solved(by_unit.transpose(0, 2, 1)).transpose(0, 2, 1)
        gram = block_diag(
            *(own[np.ix_(*(kept[kept // N_CELLS == c] % N_CELLS,) * 2)] for c, own in enumerate(sums.gram))
        )
        absorbed = moved[kept] @ reduced[kept].T
        left, own, apart = gram - absorbed - product(solved, by_unit), np.diag(gram), sums.apart[kept]
        growth = float(np.sum(apart * np.sum(left**2, axis=1) / own))
        of_pairs = sums.total[kept] ** 2 - sums.by_itself[kept]
        beyond = float(np.sum((of_pairs + apart * np.diag(absorbed)) / own))
        tau2 = max(0.0, beyond / growth) if growth > 0 else 0.0
        covariance += tau2 * moved[kept].T @ moved[kept]
        tau.append(float(np.sqrt(tau2)))
    return CommonErrors(tau[0], tau[1], np.array(tau[2:]), covariance)


def common_gradients(
    common: CommonErrors, problem: Problem, state: State, eq: NormalEquations, views: IntArray
) -> FloatArray:
    """tau s_k (K, P) of the cells in views of whole units, the units eliminated: what one standard deviation of a cell's
    error adds to the reduced gradient."""
    out = _reduced(_sums(problem, state, views), eq)
    for mine, tau in zip(_groups(len(out)), (common.pixel, common.depth, *common.depth_image), strict=True):
        out[mine] *= tau
    return out


def _groups(n: int) -> list[BoolArray]:
    """Which of n cells have one variance: those of the pixels, those of the range, and those of each camera's depth image."""
    camera, cell = np.divmod(np.arange(n), N_CELLS)
    of_range, of_image = cell >= N_PIXEL_CELLS, cell >= N_PIXEL_CELLS + RANGE_CELLS
    return [~of_range, of_range & ~of_image, *(of_image & (camera == c) for c in range(n // N_CELLS))]


def _sums(problem: Problem, state: State, some: IntArray | None) -> _Sums:
    """Of all views, or of some."""
    weights, sizes_px = problem.weights, problem.setup.sizes_px
    cells = _cells(problem.obs, sizes_px)
    K, F, P, D = len(sizes_px) * N_CELLS, problem.pattern.n_units, problem.n_globals, problem.unit_size
    n, gram, total = np.zeros(K), np.zeros((K // N_CELLS, N_CELLS, N_CELLS)), np.zeros(K)
    by_itself, pairs = np.zeros(K), np.zeros(K)
    by_global, by_unit = np.zeros((K, P)), np.zeros((F, K, D))
    for views, look, rows in problem.rows(state, some):
        of_pixels = look.kind is Kind.PIXEL
        Q, ratio = weights.parts(look.kind)
        parts = None if of_pixels else rows.parts(Q[views])
        used = (np.abs(rows.J_unit).max(axis=-1) > 0) | (np.abs(rows.J).max(axis=-1) > 0)
        for columns in (slice(0, 2),) if of_pixels else (slice(2, 3), slice(3, 4)):
            cell = cells[views][..., columns]
            view, corner, axis = np.nonzero(used & (cell >= 0))
            k = cell[view, corner, axis]
            here = np.bincount(k, minlength=K)
            n += here
            gram[look.camera] += np.diag(here.reshape(-1, N_CELLS)[look.camera])
            np.add.at(by_global, (k[:, None], rows.columns), rows.J[view, corner, axis])
            if rows.J_point.shape[-1]:
                np.add.at(by_global, (k[:, None], rows.point_columns[view, corner]), rows.J_point[view, corner, axis])
            np.add.at(by_unit, (rows.units[view], k), rows.J_unit[view, corner, axis])
            own_Q, own_r = Q[views[view], corner * cell.shape[-1] + axis], rows.r[view, corner, axis]
            (view, k), which = np.unique(np.stack([view, k]), axis=1, return_inverse=True)
            which = which.ravel()
            of_view = np.bincount(which, own_r)
            pairs += np.bincount(k, np.bincount(which) ** 2, minlength=K)
            if parts is not None:
                in_parts = np.zeros((len(k), len(ratio)))  # a' Q of each view and cell
                np.add.at(in_parts, which, own_Q)
                off = in_parts * (1 - ratio**-2)  # what W takes off
                of_view = of_view - np.sum(off * parts.r[view, 0], axis=1)  # not in place: counts of nothing are int
                dense = np.zeros((2, len(views), N_CELLS, len(ratio)))
                dense[:, view, k % N_CELLS] = in_parts, off
                gram[look.camera] -= product(*dense)
                at, off = (k[:, None], parts.point_columns[view, 0]), off[:, None]
                np.add.at(by_global, (k[:, None], parts.columns), -(off @ parts.J[view, 0])[:, 0])
                np.add.at(by_global, at, -(off @ parts.J_point[view, 0])[:, 0])
                np.add.at(by_unit, (rows.units[view], k), -(off @ parts.J_unit[view, 0])[:, 0])
            total += np.bincount(k, of_view, minlength=K)
            by_itself += np.bincount(k, of_view**2, minlength=K)
    return _Sums(n, gram, total, by_itself, 1 - pairs / np.maximum(n, 1) ** 2, by_global, by_unit)


def _reduced(sums: _Sums, eq: NormalEquations) -> FloatArray:
    """s_k (K, P), the units eliminated."""
    reduced = sums.by_global.copy()
    for WV, units, at in zip(eq.WV, eq.pattern.units, eq.pattern.columns, strict=True):
        reduced[:, at] -= np.einsum("npi,nki->kp", WV, sums.by_unit[units], optimize=True)
    return reduced


def _cells(obs: Observations, sizes_px: FloatArray) -> IntArray:
    """Cell (V, N, 4) of each residual u, v, and of the depth, over the range and over the image; -1 where there is none."""
    ranges = np.zeros(obs.has_depth.shape, int)
    for c in np.unique(obs.camera):
        mine = obs.has_depth & (obs.camera == c)[:, None]
        if mine.any():
            edges = np.quantile(obs.depth_m[mine], np.linspace(0, 1, RANGE_CELLS + 1)[1:-1])
            ranges[mine] = np.searchsorted(edges, obs.depth_m[mine])
    u = _place(obs, sizes_px, GRID)
    cell = np.stack([u, u, ranges, _place(obs, sizes_px, DEPTH_GRID)], axis=-1)
    cell += np.array([0, N_PIXEL_CELLS // 2, N_PIXEL_CELLS, N_PIXEL_CELLS + RANGE_CELLS])
    cell += obs.camera[:, None, None] * N_CELLS
    seen = np.stack([obs.has_pixel, obs.has_pixel, obs.has_depth, obs.has_depth], axis=-1)
    return np.where(seen, cell, -1)


def _place(obs: Observations, sizes_px: FloatArray, grid: tuple[int, int]) -> IntArray:
    """Cell (V, N) of a grid over the image, in which each corner is seen."""
    at = np.floor((obs.pixels_px + 0.5) / sizes_px[obs.camera][:, None] * grid).astype(int)
    across, down = np.moveaxis(np.clip(at, 0, np.array(grid) - 1), -1, 0)
    return np.asarray(across * grid[1] + down)

"""Errors that all views of a camera share, which no noise model has: at one place of the image, and at one depth.

A lens is not quite its polynomial, and a depth sensor not quite its own: it rounds, steps, and ripples over the range. Such
an error is the same for all corners near one pixel, or near one depth, so that filming more does not average it out, and a
covariance that takes the residuals for independent is too small. Here the residuals of each camera are put into cells, of
the image (u and v apart) and of the depth, and one variance is estimated for pixels and one for depth, in units of the
observations' own: r_i = e_i + tau c_k for every weighted residual i of cell k, with e_i and c_k of variance 1.

With a_k the indicator of cell k, s_k = J' a_k, A = J'J + prior and n_k = a_k' a_k, the residuals of the fit have
r = (1 - H)(e + tau sum_k c_k a_k), H = J A^-1 J', so that T = sum_k (a_k' r)^2 / n_k has the expectation

    E T = sum_k (n_k + a_k' Q (ratio^2 - 1) Q' a_k - s_k' A^-1 s_k) / n_k  +  tau^2 sum_kj (n_k [k=j] - s_k' A^-1 s_j)^2 / n_k

(the first sum with the pose parts of :mod:`.solve`), which is solved for tau^2: the method of moments for a variance
component (C. R. Henderson, Biometrics 9(2), 1953). The estimate's covariance grows by tau^2 sum_k A^-1 s_k s_k' A^-1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.bundle import solve
from rgbd_calib.rig.bundle.model import Observations, State
from rgbd_calib.rig.bundle.solve import Covariance, System, Weights
from rgbd_calib.types import Board, IntArray

GRID = (8, 6)
"""Cells of the image, across and down: finer than the lens model's own shapes, coarse enough to hold several views."""
RANGE_CELLS = 24
"""Cells of each camera's depths, with equally many corners: some cm wide, several steps of a structured-light sensor."""
N_CELLS = 2 * GRID[0] * GRID[1] + RANGE_CELLS
MIN_CORNERS = 5
"""Cells with fewer are left out."""


@dataclass(frozen=True)
class CommonErrors:
    pixel: float
    """tau: standard deviation of what a cell's pixels share, in sigmas of one of them."""
    depth: float
    """The same of the depth."""
    covariance: FloatArray
    """(P, P) that they add to the global parameters'."""


def common_errors(
    state: State,
    obs: Observations,
    board: Board,
    weights: Weights,
    system: System,
    cov: Covariance,
    sizes_px: FloatArray,
) -> CommonErrors:
    """Estimate what residuals share at the minimum, from its equations; `sizes_px` (C, 2): width and height of the images."""
    cells = _cells(obs, sizes_px)
    K, F, P = len(sizes_px) * N_CELLS, len(state.T_parent_board), state.n_global
    n, total, in_pose = np.zeros(K), np.zeros(K), np.zeros(K)
    D = state.n_structure
    by_global, by_structure = np.zeros((K, P)), np.zeros((F, K, D))
    ratios = weights.ratio_pixel, weights.ratio_depth
    for part in solve.blocks(state, obs, board, weights):
        cell = cells[part.views]
        used = np.abs(part.J).max(axis=-1) > 0
        row, corner, axis = np.nonzero(used & (cell >= 0))
        k, J = cell[row, corner, axis], part.J[row, corner, axis]
        n += np.bincount(k, minlength=K)
        total += np.bincount(k, part.r[row, corner, axis], minlength=K)
        np.add.at(by_global, (k[:, None], part.columns[row]), J[:, :-D])
        np.add.at(by_structure, (part.frame[row], k), J[:, -D:])
        for rows, Q, ratio in ((axis < 2, weights.Q_pixel, ratios[0]), (axis == 2, weights.Q_depth, ratios[1])):
            place = (corner * 2 + axis if Q is weights.Q_pixel else corner)[rows]
            view, where = row[rows] + part.views.start, k[rows]
            pairs, which = np.unique(np.stack([view, where]), axis=1, return_inverse=True)
            sums = np.zeros((pairs.shape[1], Q.shape[2]))
            np.add.at(sums, which.ravel(), Q[view, place])
            in_pose += np.bincount(pairs[1], sums**2 @ (ratio**2 - 1), minlength=K)
    of_depth = np.arange(K) % N_CELLS >= N_CELLS - RANGE_CELLS
    V_inv = np.linalg.inv(system.V)
    reduced = by_global - np.einsum("fpi,fki->kp", system.W @ V_inv, by_structure, optimize=True)
    moved = by_global @ cov.cameras + np.einsum("fpi,fki->kp", cov.cross, by_structure, optimize=True)  # A^-1 s_k
    absorbed = moved @ reduced.T + solve.product(by_structure @ V_inv, by_structure)
    tau = []
    covariance = np.zeros((P, P))
    for mine in (~of_depth, of_depth):
        kept = np.flatnonzero(mine & (n >= MIN_CORNERS))
        own = absorbed[np.ix_(kept, kept)]
        expected = np.sum((n[kept] + in_pose[kept] - np.diag(own)) / n[kept])
        growth = np.sum((np.diag(n[kept]) - own) ** 2 / n[kept, None])
        tau2 = max(0.0, float(np.sum(total[kept] ** 2 / n[kept]) - expected) / growth) if growth > 0 else 0.0
        covariance += tau2 * moved[kept].T @ moved[kept]
        tau.append(float(np.sqrt(tau2)))
    return CommonErrors(tau[0], tau[1], covariance)


def _cells(obs: Observations, sizes_px: FloatArray) -> IntArray:
    """Cell (V, N, 3) of each residual u, v, depth; -1 where there is none."""
    size = sizes_px[obs.camera][:, None]
    across, down = np.moveaxis(np.floor((obs.pixels_px + 0.5) / size * GRID).astype(int), -1, 0)
    place = np.clip(across, 0, GRID[0] - 1) * GRID[1] + np.clip(down, 0, GRID[1] - 1)
    ranges = np.zeros(obs.has_depth.shape, int)
    for c in np.unique(obs.camera):
        mine = obs.has_depth & (obs.camera == c)[:, None]
        if mine.any():
            edges = np.quantile(obs.depth_m[mine], np.linspace(0, 1, RANGE_CELLS + 1)[1:-1])
            ranges[mine] = np.searchsorted(edges, obs.depth_m[mine])
    n_image = GRID[0] * GRID[1]
    cell = np.stack([place, n_image + place, 2 * n_image + ranges], axis=-1) + obs.camera[:, None, None] * N_CELLS
    seen = np.stack([obs.has_pixel, obs.has_pixel, obs.has_depth], axis=-1)
    return np.where(seen, cell, -1)

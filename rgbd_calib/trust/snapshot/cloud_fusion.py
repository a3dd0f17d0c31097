"""Poses of a rig from what is known of it and what clouds of its cameras say, each by its covariance.

The rows are those of :mod:`.cloud_rows`, linear in u and q with the priors N(0, I); poses move, so that patches are sought again
and linearised anew. Weights are Tukey's. The noise has a factor from the residuals, times an inflation for what the rows of
a cell of the image share beyond the model: with B = [J L, S], C the covariance of (u, q), a_k the indicator of the n_k rows of cell
k and lambda the inflation of their mean's variance, the residuals r of the minimum have

    E (a_k' r)^2 / n_k = lambda sigma^2 - a_k' B C B' a_k / n_k

which is solved for lambda by its mean over the cells.

Only poses are changed. Lenses and depth errors are counted with their covariance and stay (a filter of Schmidt's): what a scene
errs by for reasons of its own, at edges, at distances that no board was at, must not become a property of the camera. With D
the projection on poses, Sigma the covariance before and Delta = Sigma - L C_uu L' what the clouds would take off it, that after is
Sigma - D Delta - Delta D + D Delta D. Where the clouds differ from the rig by more than both covariances, it is multiplied by
how much more (R. T. Birge, Physical Review 40, 1932).

References
----------
S. F. Schmidt, Application of state-space methods to navigation problems, Advances in Control Systems 3, 1966.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.linear import BoolArray
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.trust.snapshot import tukey
from rgbd_calib.trust.snapshot.cloud_rows import CloudRows, cloud_rows
from rgbd_calib.trust.snapshot.clouds import GATE_M
from rgbd_calib.trust.snapshot.motion import ANYWHERE
from rgbd_calib.trust.snapshot.surfaces import Surface
from rgbd_calib.trust.uncertainty import JointCovariance
from rgbd_calib.types import Rig

_ROUNDS, _STEPS = 4, 5
_REACH_AT_M = 2.0
_LEAST_SIGMA, _LEAST_LEFT = 0.1, 0.05
_TOLD = 0.5
"""A direction of u of which the clouds leave less than this of the variance is one that they tell."""


@dataclass(frozen=True)
class Fusion:
    """What the clouds change."""

    rig: Rig
    """With other poses."""
    joint: JointCovariance
    """Afterwards."""
    by_clouds: dict[str, FloatArray]
    """(6, 6) by camera, covariance of its pose (rad, m, in the world) by the clouds and what is known of the depth alone."""
    patches: dict[tuple[str, str], int]
    """Used, by pair of cameras."""
    sigma: float
    """Noise of a row, in deviations expected of it."""
    inflation: float
    """Times the variance of independent rows."""
    surprise: float
    """Mean square of what the clouds tell of u: 1 where the rig's covariance is right."""


def fuse_clouds(rig: Rig, joint: JointCovariance, instants: Sequence[Mapping[str, Surface]]) -> Fusion | None:
    """The most likely poses; None where no two cameras see the same surfaces."""
    of_pose = np.zeros(len(joint.matrix), bool)
    for own in joint.parameters.values():
        of_pose[own["pose"]] = True
    L, reach = _factor(joint.matrix), _factor(joint.loosened(rig.reference, GATE_M, _REACH_AT_M).matrix)
    K, u = L.shape[1], np.zeros(L.shape[1])
    for _ in range(_ROUNDS):
        theta = L @ u
        found = cloud_rows(posed(rig, joint, theta), joint, instants)
        if found is None:
            return None
        rows = found
        noise = _noise(_System(rows, reach, theta, of_pose))
        system = _System(rows, L, theta, of_pose)
        u = system.solved(noise.w)[:K]
    C = system.covariance(noise.w)[:K, :K]
    left, axes = np.linalg.eigh(C)
    told = left < _TOLD
    surprise = float(np.mean((axes.T @ u)[told] ** 2 / (1 - left[told]))) if told.any() else 0.0
    less = joint.matrix - L @ C @ L.T
    both = np.outer(of_pose, of_pose) | np.not_equal.outer(of_pose, of_pose)
    after = (joint.matrix - np.where(both, less, 0.0)) * max(surprise, 1.0)
    moved = posed(rig, joint, L @ u)
    cameras = {
        name: replace(moved.cameras[name], covariance=after[np.ix_(own["pose"], own["pose"])])
        for name, own in joint.parameters.items()
    }
    used: dict[tuple[str, str], int] = {}
    for k, pair in enumerate(rows.pairs):
        used[pair] = used.get(pair, 0) + int(np.count_nonzero(noise.w[rows.pair == k] > 0))
    return Fusion(
        replace(rig, cameras=rig.cameras | cameras),
        replace(joint, matrix=after),
        _by_clouds(_anchor(rig, rows), joint, rows, theta, noise.w, of_pose),
        used,
        noise.sigma,
        noise.inflation,
        surprise,
    )


def posed(rig: Rig, joint: JointCovariance, theta: FloatArray) -> Rig:
    """The rig with its poses, and only these, moved by a change (P,) of its parameters."""
    cameras = {
        name: replace(rig.cameras[name], T_world_color=se3.retract(rig.cameras[name].T_world_color, theta[own["pose"]]))
        for name, own in joint.parameters.items()
    }
    return replace(rig, cameras=rig.cameras | cameras)


class _System:
    """The rows, linear in (u, q)."""

    def __init__(self, rows: CloudRows, L: FloatArray, theta: FloatArray, of_pose: BoolArray) -> None:
        # the places are those of the moved poses: all other parameters are where they were
        self._r0 = (rows.distance_m - rows.J[:, of_pose] @ theta[of_pose]) / rows.sigma_m
        self._A = (rows.J @ L) / rows.sigma_m[:, None]
        S = rows.shared.multiply(1 / rows.sigma_m[:, None]).tocsc()
        self._S = S[:, np.flatnonzero(abs(S).sum(axis=0))].tocsr()
        self._cell, self._K, self.rows = rows.cell, L.shape[1], len(rows.cell)
        self.size = self._K + self._S.shape[1]

    def residuals(self, u_q: FloatArray) -> FloatArray:
        """(n,), in deviations expected."""
        return np.asarray(self._r0 + self._A @ u_q[: self._K] + self._S @ u_q[self._K :])

    def solved(self, w: FloatArray) -> FloatArray:
        """(u, q) of rows with these weights (n,)."""
        g = np.concatenate([self._A.T @ (w * self._r0), self._S.T @ (w * self._r0)])
        return -np.asarray(cho_solve(cho_factor(self._information(w)), g))

    def covariance(self, w: FloatArray) -> FloatArray:
        """Of (u, q)."""
        return np.asarray(cho_solve(cho_factor(self._information(w)), np.eye(self.size)))

    def leverage(self, w: FloatArray) -> FloatArray:
        """(n,), share of each row's variance that the solution takes up."""
        B = np.concatenate([self._A, self._S.toarray()], axis=1)
        half = solve_triangular(np.linalg.cholesky(self._information(w)), B.T, lower=True)
        return np.asarray(w * np.sum(half**2, axis=0))

    def inflation(self, u_q: FloatArray, w: FloatArray, sigma: float) -> float:
        """Of the variance of a cell's mean, over that of independent rows of this deviation; at least 1."""
        used = w > 0
        cells, cell = np.unique(self._cell[used], return_inverse=True)
        of_cell = sparse.csr_array((np.ones(len(cell)), (cell, np.flatnonzero(used))), shape=(len(cells), len(w)))
        n = np.bincount(cell)
        G = np.concatenate([of_cell @ self._A, (of_cell @ self._S).toarray()], axis=1)
        squares = (of_cell @ self.residuals(u_q)) ** 2 + np.einsum("ki,ki->k", G @ self.covariance(w), G)
        return max(float(np.mean(squares / n)) / sigma**2, 1.0)

    def _information(self, w: FloatArray) -> FloatArray:
        K, wA = self._K, self._A * w[:, None]
        H = np.eye(self.size)
        H[:K, :K] += self._A.T @ wA
        H[K:, :K] = self._S.T @ wA
        H[:K, K:] = H[K:, :K].T
        H[K:, K:] += (self._S.T @ self._S.multiply(w[:, None])).toarray()
        return H


def _factor(matrix: FloatArray) -> FloatArray:
    """L (P, K) with L L' = the matrix (P, P), which may be singular."""
    sd = np.sqrt(np.diag(matrix))
    scale = np.where(sd > 0, sd, 1.0)
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    kept = values > 1e-12 * values[-1]
    return np.asarray(scale[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


@dataclass(frozen=True)
class _Noise:
    w: FloatArray
    """(n,), weights over the variance."""
    sigma: float
    inflation: float


def _noise(system: _System) -> _Noise:
    """Of rows by what they leave where the poses follow the clouds: a rig that is wrong must not pass for noise."""
    u_q, leverage, inflation = np.zeros(system.size), np.zeros(system.rows), 1.0
    for _ in range(_STEPS):
        sigma, weight = _weights(system.residuals(u_q), leverage)
        w = weight / (sigma**2 * inflation)
        u_q, leverage = system.solved(w), system.leverage(w)
        inflation = system.inflation(u_q, w, sigma)
    return _Noise(weight / (sigma**2 * inflation), sigma, inflation)


def _weights(r: FloatArray, leverage: FloatArray) -> tuple[float, FloatArray]:
    """Deviation of the noise by residuals (n,) of this leverage, and Tukey's weights (n,)."""
    size = np.abs(r) / np.sqrt(np.maximum(1 - leverage, _LEAST_LEFT))
    sigma = tukey.scale(size, 1, _LEAST_SIGMA)
    return sigma, tukey.weights(size, sigma)[1]


def _anchor(rig: Rig, rows: CloudRows) -> str:
    """The camera that others are free against: the reference, or one that sees what others see."""
    seeing = {name for pair in rows.pairs for name in pair}
    return rig.reference if rig.reference in seeing else next(name for name in rig.cameras if name in seeing)


def _by_clouds(
    anchor: str, joint: JointCovariance, rows: CloudRows, theta: FloatArray, w: FloatArray, of_pose: BoolArray
) -> dict[str, FloatArray]:
    """Covariance of poses that may be anywhere, but for the anchor's."""
    wide = np.where(of_pose | of_pose[:, None], 0.0, joint.matrix)
    free = {name: own["pose"] for name, own in joint.parameters.items() if name != anchor}
    for at in free.values():
        wide[at, at] = ANYWHERE**2
    L = _factor(wide)
    system = _System(rows, L, theta, of_pose)
    C = L @ system.covariance(w)[: L.shape[1], : L.shape[1]] @ L.T
    return {name: C[np.ix_(at, at)] for name, at in free.items()}

"""Tests of a least-squares solution against what its model leaves out, without solving again.

Rows of view v, in sigmas: r = J_g x_g + J_b x_b(frame) + A a + e, with x_g the global parameters, x_b a pose of the board
for each frame, and A a an error that the model does not have (a camera that moved half-way, a board of another size).
With C the inverse of the normal equations, priors included, and M = I - J C J', the residuals of the solution are M e, and

    score        s = A' M r                        information   I = A' M A
    estimate     a = -I^-1 s                       Var(s) = I + sum_v (Q_v' M A)' diag(excess) (Q_v' M A)
    statistic    T = s' Var(s)^-1 s ~ chi2(q)      where the model is right                                  (Rao's score test)

`excess` is by how much the variance of a view's pose part exceeds that of its other residuals: errors of one view are
not independent (the sandwich of the bundle's own covariance). a is exactly what a new linear solution with A added would
give. Only products of each view's rows are kept, so that the size of a test does not depend on the number of corners.

References
----------
C. R. Rao, Large sample tests of statistical hypotheses, Math. Proc. Camb. Phil. Soc. 44(1), 1948.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.stats import chi2

from rgbd_calib.geometry.inverse import symmetric_inverse
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import IntArray

NO_MOMENT = -1
"""Moment of views of another recording: of each camera alone."""
SEEN = 1e-4
"""A direction of A of which M leaves less than this share is what the model has already."""
WEAK = 1e-6
"""What is left of a prior's information that is put out of use."""
CLEAR_SIGMAS = 3.0
"""Parts of an estimate below this many of their standard deviations do not count towards its size."""


@dataclass(frozen=True)
class Equations:
    """A solution's equations, as products of each view's rows; V views, F boards, P global parameters, G local columns."""

    cameras: tuple[str, ...]
    camera: IntArray
    """(V,)."""
    frame: IntArray
    """(V,), number of the board's pose."""
    moment: IntArray
    """(V,), place of the frame in time, from 0; NO_MOMENT for views of another recording."""
    shared: IntArray
    """(V,) bool: other cameras see the board in this frame too."""
    moments: tuple[str, ...]
    """Names of the frames, by moment."""
    local: Mapping[str, slice]
    """Local columns by name: those of the model (pose, lens, bias, bow, board), and of errors that it lacks."""
    model: IntArray
    """(L,), local columns of the global parameters."""
    index: IntArray
    """(V, L), the global parameter of each of these."""
    active: IntArray
    """(V, L) bool: it counts in this view."""
    gram: FloatArray
    """(V, G, G), of the rows in sigmas."""
    score: FloatArray
    """(V, G), the columns' products with the residuals, predicted less measured."""
    low: FloatArray
    """(V, D, G), the columns' parts in what a board moved in this view alone would change."""
    parts: FloatArray
    """(V, D), the residuals' own."""
    groups: IntArray
    """(D,), which of them have one variance."""
    excess: FloatArray
    """(D,), by how much that exceeds 1; see :meth:`weighed`."""
    size: FloatArray
    """(V, G, G), products of the columns in metres at the board, for the size of an effect."""
    corners: IntArray
    """(V,), corners behind `size`."""
    distance_m: FloatArray
    """(V,), of the board from its camera."""
    prior: FloatArray
    """(P, P), information."""
    prior_gradient: FloatArray
    """(P,)."""
    free: IntArray
    """(P,) bool."""

    @property
    def n_boards(self) -> int:
        return int(self.frame.max()) + 1

    @property
    def board(self) -> slice:
        return self.local["board"]

    def extended(self, columns: IntArray, where: IntArray) -> Equations:
        """The same with the errors `columns`, (q,), of the views `where`, (V,) bool, as parameters of the model."""
        P, q = len(self.free), len(columns)
        prior = np.zeros((P + q, P + q))
        prior[:P, :P] = self.prior
        return replace(
            self,
            model=np.concatenate([self.model, columns]),
            index=np.concatenate([self.index, np.broadcast_to(np.arange(P, P + q), (len(where), q))], axis=1),
            active=np.concatenate([self.active, np.broadcast_to(where[:, None], (len(where), q))], axis=1),
            prior=prior,
            prior_gradient=np.concatenate([self.prior_gradient, np.zeros(q)]),
            free=np.concatenate([self.free, np.ones(q, bool)]),
        )

    def without_prior(self, parameters: IntArray) -> Equations:
        """The same, these parameters not known before."""
        prior, gradient = self.prior.copy(), self.prior_gradient.copy()
        keep = prior[parameters, parameters] * WEAK
        prior[parameters], prior[:, parameters], gradient[parameters] = 0.0, 0.0, gradient[parameters] * WEAK
        prior[parameters, parameters] = keep
        return replace(self, prior=prior, prior_gradient=gradient)

    def weighed(self) -> Equations:
        """The same with the excess that its residuals show."""
        return self.with_excess(pose_excess(self))

    def with_excess(self, excess: FloatArray) -> Equations:
        """The same with another excess; what does not depend on it is not computed again."""
        other = replace(self, excess=excess)
        other.__dict__.update({k: v for k, v in self.__dict__.items() if k in _WITHOUT_EXCESS})
        return other

    @property
    def freedom(self) -> int:
        """Degrees of freedom of one variance of the pose parts: views that others check, less the cameras' poses."""
        frames, views = len(np.unique(self.frame[self.shared])), int(self.shared.sum())
        return max(views - frames - len(self.cameras) + 1, 1)

    @cached_property
    def by_model(self) -> FloatArray:
        """(V, L, G), products of the global parameters' columns with all."""
        return self.gram[:, self.model] * self.active[..., None]

    @cached_property
    def low_by_model(self) -> FloatArray:
        """(V, D, L)."""
        return self.low[:, :, self.model] * self.active[:, None]

    @cached_property
    def W(self) -> FloatArray:
        """(F, P, 6)."""
        W = np.zeros((self.n_boards, len(self.free), 6))
        np.add.at(W, (self.frame[:, None], self.index), self.by_model[:, :, self.board])
        return W * self.free[:, None]

    @cached_property
    def V_inv(self) -> FloatArray:
        """(F, 6, 6)."""
        V = np.zeros((self.n_boards, 6, 6))
        np.add.at(V, self.frame, self.gram[:, self.board, self.board])
        V[np.trace(V, axis1=1, axis2=2) == 0] = np.eye(6)
        return np.asarray(np.linalg.inv(V), np.float64)

    @cached_property
    def board_gradient(self) -> FloatArray:
        """(F, 6)."""
        g = np.zeros((self.n_boards, 6))
        np.add.at(g, self.frame, self.score[:, self.board])
        return g

    @cached_property
    def frame_information(self) -> FloatArray:
        """(F, P, P), what each frame adds to the reduced equations, its board eliminated."""
        P = len(self.free)
        S = np.zeros((self.n_boards, P, P))
        own = self.by_model[:, :, self.model] * self.active[:, None]
        for v, f in enumerate(self.frame):
            S[f][np.ix_(self.index[v], self.index[v])] += own[v]
        S *= np.outer(self.free, self.free)
        return S - self.W @ self.V_inv @ self.W.transpose(0, 2, 1)

    @cached_property
    def frame_gradient(self) -> FloatArray:
        """(F, P), likewise."""
        g = np.zeros((self.n_boards, len(self.free)))
        np.add.at(g, (self.frame[:, None], self.index), self.score[:, self.model] * self.active)
        g *= self.free
        return g - np.einsum("fpi,fij,fj->fp", self.W, self.V_inv, self.board_gradient, optimize=True)

    @cached_property
    def information(self) -> FloatArray:
        """(P, P), reduced; one on the diagonal of what is held."""
        S = self.frame_information.sum(axis=0) + self.prior * np.outer(self.free, self.free)
        return S + np.diag(1.0 - self.free)

    @cached_property
    def covariance(self) -> FloatArray:
        """(P, P), of the free parameters, all residuals independent."""
        return symmetric_inverse(self.information) * np.outer(self.free, self.free)

    @cached_property
    def step(self) -> tuple[FloatArray, FloatArray]:
        """What the solution still lacks of the minimum, (P,) and (F, 6): zero but for rounding and what was held."""
        x = -self.covariance @ (self.frame_gradient.sum(axis=0) + self.prior_gradient * self.free)
        return x, -np.einsum("fij,fj->fi", self.V_inv, self.board_gradient + np.einsum("fpi,p->fi", self.W, x))

    @cached_property
    def frame_excess(self) -> FloatArray:
        """(F, P, P), what the excess of the pose parts adds to the variance of each frame's reduced gradient."""
        P = len(self.free)
        out = np.zeros((self.n_boards, P, P))
        carried = self.V_inv @ self.W.transpose(0, 2, 1)
        for v, f in enumerate(self.frame):
            rows = -self.low[v][:, self.board] @ carried[f]
            rows[:, self.index[v]] += self.low_by_model[v] * self.free[self.index[v]]
            out[f] += rows.T @ (self.excess[:, None] * rows)
        return out

    @cached_property
    def honest_covariance(self) -> FloatArray:
        """(P, P), the excess counted."""
        honest: FloatArray = self.covariance + self.covariance @ self.frame_excess.sum(axis=0) @ self.covariance
        return honest


_WITHOUT_EXCESS = (
    "by_model",
    "low_by_model",
    "W",
    "V_inv",
    "board_gradient",
    "frame_information",
    "frame_gradient",
    "information",
    "covariance",
    "step",
)


@dataclass(frozen=True)
class Score:
    """Outcome of a score test."""

    statistic: float
    plain: float
    """The statistic without the excess of the pose parts."""
    freedom: int
    p: float
    estimate: FloatArray
    """(q,)."""
    covariance: FloatArray
    """(q, q)."""
    effect_m: float
    """RMS over the corners concerned of what the clear part of the estimate moves them by, metres."""


def pose_excess(eq: Equations) -> FloatArray:
    """By how much the variance of the views' pose parts exceeds 1, (D,), from those parts of the residuals.

    One variance for each of the groups: a board that is offset as a whole is another matter than one that is tilted.
    With m = q' M q, E (q' r)^2 = m + excess m^2 but for what parts share, so that the moments give it.
    """
    carried = eq.low_by_model * eq.free[eq.index][:, None]
    on_board = eq.low[:, :, eq.board]
    reduced = np.zeros((*carried.shape[:2], len(eq.free)))
    for d in range(reduced.shape[1]):
        np.add.at(reduced[:, d], (np.arange(len(eq.frame))[:, None], eq.index), carried[:, d])
    reduced -= on_board @ eq.V_inv[eq.frame] @ eq.W[eq.frame].transpose(0, 2, 1)
    absorbed = np.einsum("vdp,pq,vdq->vd", reduced, eq.covariance, reduced, optimize=True)
    absorbed += np.einsum("vdi,vij,vdj->vd", on_board, eq.V_inv[eq.frame], on_board, optimize=True)
    there = np.any(eq.low != 0, axis=2) & eq.shared[:, None]
    m = np.where(there, np.clip(1 - absorbed, 0.0, 1.0), 0.0)
    x, b = eq.step
    now = (
        eq.parts
        + np.einsum("vdl,vl->vd", eq.low_by_model, x[eq.index])
        + np.einsum("vdi,vi->vd", on_board, b[eq.frame])
    )
    squares = np.where(there, now**2, 0.0)
    out = np.zeros(len(eq.groups))
    for g in np.unique(eq.groups):
        own = eq.groups == g
        weight = float(np.sum(m[:, own] ** 2))
        out[own] = max(0.0, float(squares[:, own].sum() - m[:, own].sum()) / weight) if weight > 1 else 0.0
    return out


def score_test(
    eq: Equations, columns: IntArray, where: IntArray, effect: FloatArray | None = None, least_seen: float = SEEN
) -> Score:
    """Would the solution gain by the errors `columns` in the views `where`?

    Parameters
    ----------
    columns : (q,), local columns.
    where : (V,) bool.
    effect : (q, q), mean square of the error in metres as a quadratic form of the estimate; None: of `size`.
    least_seen : share of A that M must leave.
    """
    q = len(columns)
    rows = np.flatnonzero(where)
    gram, of_model = eq.gram[rows][:, :, columns], eq.by_model[rows][:, :, columns]
    cross = np.zeros((len(eq.free), q))  # J_g' A
    np.add.at(cross, eq.index[rows], of_model)
    cross *= eq.free[:, None]
    boards = np.zeros((eq.n_boards, 6, q))  # J_b' A
    np.add.at(boards, eq.frame[rows], gram[:, eq.board])
    VB = eq.V_inv @ boards
    cross = cross - np.einsum("fpi,fiq->pq", eq.W, VB, optimize=True)
    X = eq.covariance @ cross
    Y = VB - np.einsum("fij,fpj,pq->fiq", eq.V_inv, eq.W, X, optimize=True)
    own = gram[:, columns].sum(axis=0)
    information = own - np.einsum("fip,fiq->pq", boards, VB, optimize=True) - cross.T @ X
    x, b = eq.step
    score = eq.score[rows][:, columns].sum(axis=0) + np.einsum("vlq,vl->q", of_model, x[eq.index[rows]])
    score = score + np.einsum("viq,vi->q", gram[:, eq.board], b[eq.frame[rows]])
    low = np.zeros((len(eq.frame), eq.low.shape[1], q))
    low[rows] = eq.low[rows][:, :, columns]
    low -= eq.low_by_model @ X[eq.index] + eq.low[:, :, eq.board] @ Y[eq.frame]
    variance = information + np.einsum("d,vdp,vdq->pq", eq.excess, low, low, optimize=True)
    if effect is None:
        effect = eq.size[rows][:, columns[:, None], columns].sum(axis=0) / max(int(eq.corners[rows].sum()), 1)
    return judge(score, information, variance, np.sqrt(np.maximum(np.diag(own), 1e-300)), effect, least_seen)


def judge(
    score: FloatArray,
    information: FloatArray,
    variance: FloatArray,
    scale: FloatArray,
    effect: FloatArray,
    least_seen: float,
) -> Score:
    """Statistic, estimate and clear effect of a score (q,), directions that the model has already left out."""
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    kept = values > least_seen
    if not kept.any():
        return Score(0.0, 0.0, 0, 1.0, np.zeros(len(score)), np.zeros((len(score),) * 2), 0.0)
    U = vectors[:, kept]
    s, var = U.T @ (score / scale), U.T @ (variance / np.outer(scale, scale)) @ U
    statistic, plain = float(s @ np.linalg.solve(var, s)), float(s @ (s / values[kept]))
    B = U / values[kept] / scale[:, None]  # estimate = -B s
    estimate, covariance = -B @ s, B @ var @ B.T
    freedom = int(kept.sum())
    return Score(
        statistic,
        plain,
        freedom,
        float(chi2.sf(statistic, freedom)),
        estimate,
        covariance,
        clear_effect(-s, var, B, effect),
    )


def clear_effect(s: FloatArray, variance: FloatArray, B: FloatArray, effect: FloatArray) -> float:
    """Root of a' E a over the parts of a = B s, s of this variance, that stand out of their noise."""
    L = np.linalg.cholesky(variance)
    y = np.linalg.solve(L, s)
    BL = B @ L
    sizes, axes = np.linalg.eigh(BL.T @ effect @ BL)
    parts = axes.T @ y
    return float(np.sqrt(np.sum((np.maximum(sizes, 0) * parts**2)[np.abs(parts) > CLEAR_SIGMAS])))

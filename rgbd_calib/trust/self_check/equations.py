"""Tests of a least-squares solution against what its model leaves out, without solving again.

Rows of view v, in sigmas: r = J x + A a + e, with x all unknowns of the problem (the globals, and the unit of each frame),
and A a an error that the model does not have (a camera that moved half-way, a board of another size). With C the inverse of
the normal equations, priors included, and M = I - J C J', the residuals of the solution are M e, and

    score        s = A' M r                        information   I = A' M A
    estimate     a = -I^-1 s                       Var(s) = I + sum_v (Q_v' M A)' diag(excess) (Q_v' M A)
    statistic    T = s' Var(s)^-1 s ~ chi2(q)      where the model is right                                  (Rao's score test)

Where errors of one view are not independent, rows are those of generalised least squares, W^(1/2) times r, J and A
(:mod:`rgbd_calib.rig.weights`), and `excess` is by how much the variance of a view's pose part exceeds what it is weighed by.
a is exactly what a new linear solution with A added would give. Errors E that are taken into the model change M to M - M E (E' M E)^-1 E' M. Only products of each view's rows are kept,
so that the size of a test does not depend on the number of corners.

References
----------
C. R. Rao, Large sample tests of statistical hypotheses, Math. Proc. Camb. Phil. Soc. 44(1), 1948.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rgbd_calib.geometry.linear import BoolArray, Covariance, IntArray, NormalEquations
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.geometry.tails import chi2_sf
from rgbd_calib.trust.self_check.model import SolvedModel, ViewRows

ALONE = -1
"""Time index of views of another recording: of each camera alone."""
SEEN = 1e-4
"""A direction of A of which M leaves less than this share is what the model has already."""
WEAK = 1e-6
"""What is left of a prior's information that is put out of use."""
CLEAR_SIGMAS = 3.0
"""Parts of an estimate below this many of their standard deviations do not count towards its size."""


@dataclass(frozen=True)
class Projected:
    """Columns of an error in some views, less what the model of the globals and units has of them."""

    columns: IntArray
    """(q,)."""
    where: BoolArray
    """(V,)."""
    reduced: FloatArray
    """(P, q), J'A with the units eliminated."""
    units: FloatArray
    """(F, D, q), J_unit' A."""
    own: FloatArray
    """(q, q), A'A."""
    score: FloatArray
    """(q,)."""
    information: FloatArray
    """(q, q)."""
    low: FloatArray
    """(V, parts, q), Q' M A."""


@dataclass(frozen=True)
class Equations:
    """A solution's equations; V views."""

    cameras: tuple[str, ...]
    camera: IntArray
    """(V,)."""
    time_index: IntArray
    """(V,), place of the frame in time, from 0; ALONE for views of another recording."""
    shared: BoolArray
    """(V,) bool: other cameras see the board in this frame too."""
    frames: tuple[str, ...]
    """Names of the frames, in order of time."""
    columns: Mapping[str, slice]
    """Columns of possible errors by name."""
    model: SolvedModel
    prior: FloatArray
    """(P, P), information."""
    prior_gradient: FloatArray
    """(P,)."""
    corners: IntArray
    """(V,), corners behind `size`."""
    distance_m: FloatArray
    """(V,), of the board from its camera."""
    groups: IntArray
    """(parts,), which pose parts have one variance."""
    ratio: FloatArray
    """(parts,), deviation by which they are weighed, over that of single residuals."""
    excess: FloatArray
    """(parts,), by how much their variance exceeds what they are weighed by, in units of that; see :meth:`weighed`."""
    part: Callable[[IntArray], NormalEquations]
    """Normal equations of the rows of some views alone."""
    part_in_metres: Callable[[IntArray], NormalEquations]
    """The same, rows in metres at the board instead of sigmas, and such that units can be eliminated."""
    common: Callable[[IntArray], FloatArray]
    """What errors that views of a camera share add to the reduced gradient of some views (K, P), K independent errors of
    variance 1; see :mod:`rgbd_calib.rig.common_errors`."""
    taken: tuple[Projected, ...] = ()
    """Errors that are in the model now."""

    @property
    def least_excess(self) -> FloatArray:
        """(parts,), where the pose parts vary as single residuals do."""
        return np.asarray(self.ratio**-2.0 - 1)

    @property
    def rows(self) -> ViewRows:
        return self.model.rows

    @property
    def plain(self) -> Covariance:
        """Of the model."""
        return self.model.plain

    @property
    def free(self) -> BoolArray:
        """(P,)."""
        return self.model.free

    @property
    def base(self) -> NormalEquations:
        return self.plain.equations

    @cached_property
    def common_of_all(self) -> FloatArray:
        """(K, P), `common` of all views."""
        return self.common(np.arange(len(self.camera)))

    @cached_property
    def dof(self) -> FloatArray:
        """(K,), degrees of freedom of the variance of one pose part of a kind: views, less what boards and cameras absorb."""
        left, kind = pose_residuals(self)[1], self.rows.kind
        return np.array([max(float(left[:, kind == k].sum(axis=0).mean()), 1.0) for k in np.unique(kind)])

    def project(self, columns: IntArray, where: BoolArray) -> Projected:
        """The errors `columns` (q,) of the views `where` (V,), before what was taken into the model."""
        own, base, q = self.rows, self.base, len(columns)
        views = np.flatnonzero(where)
        gram = own.gram[views][:, columns[:, None], columns].sum(axis=0)
        cross = np.zeros((len(self.free), q))
        by_globals = own.by_globals[views][:, columns].transpose(0, 2, 1)  # (v, L, q)
        np.add.at(cross, own.index[views], by_globals)
        units = np.zeros((base.pattern.n_units, base.pattern.size, q))
        np.add.at(units, own.units[views], own.by_unit[views][:, :, columns].transpose(0, 1, 3, 2))
        for WV, members, at in zip(base.WV, base.pattern.units, base.pattern.columns, strict=True):
            cross[at] -= np.einsum("npd,ndq->pq", WV, units[members], optimize=True)
        cross *= self.free[:, None]
        X = self.plain.of_globals @ cross
        Y = self._unit_part(X, units)
        solved = base.unit_solved(units)
        information = gram - np.einsum("fdp,fdq->pq", units, solved, optimize=True) - cross.T @ X
        x, b = self.model.step
        score = own.score[views][:, columns].sum(axis=0) + np.einsum("vlq,vl->q", by_globals, x[own.index[views]])
        score += np.einsum("vkqd,vkd->q", own.by_unit[views][:, :, columns], b[own.units[views]])
        low = np.zeros((len(where), own.low.shape[1], q))
        low[views] = own.low[views][:, :, columns]
        low -= own.low_globals @ X + np.einsum("vpd,vpdq->vpq", own.low_unit, Y[own.unit_of_part])
        return Projected(columns, where, cross, units, gram, score, information, low)

    def _unit_part(self, X: FloatArray, units: FloatArray) -> FloatArray:
        """(F, D, q), the units' share of C J'A, given the globals' X (P, q)."""
        out = self.base.unit_solved(units)
        for WV, members, at in zip(self.base.WV, self.base.pattern.units, self.base.pattern.columns, strict=True):
            out[members] -= WV.transpose(0, 2, 1) @ X[at]
        return out

    def overlap(self, a: Projected, b: Projected) -> FloatArray:
        """A' M B (p, q), before what was taken into the model."""
        both = np.flatnonzero(a.where & b.where)
        gram = self.rows.gram[both][:, a.columns[:, None], b.columns].sum(axis=0)
        through_units = np.einsum("fdp,fdq->pq", a.units, self.base.unit_solved(b.units), optimize=True)
        return np.asarray(gram - through_units - a.reduced.T @ self.plain.of_globals @ b.reduced)

    def of_taken(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(E' M E)^-1, the score and the pose parts of what was taken, as one."""
        blocks = [[self.overlap(a, b) for b in self.taken] for a in self.taken]
        inverse = np.linalg.pinv(np.block(blocks), hermitian=True)
        return (
            inverse,
            np.concatenate([t.score for t in self.taken]),
            np.concatenate([t.low for t in self.taken], axis=2),
        )

    def within(self, projected: Projected) -> Projected:
        """What is left of it once what was taken is in the model."""
        if not self.taken:
            return projected
        inverse, score, low = self.of_taken()
        K = np.concatenate([self.overlap(t, projected) for t in self.taken])
        return replace(
            projected,
            score=projected.score - K.T @ inverse @ score,
            information=projected.information - K.T @ inverse @ K,
            low=projected.low - low @ inverse @ K,
        )

    def with_error(self, columns: IntArray, where: BoolArray) -> Equations:
        """With these errors in the model."""
        return replace(self, taken=(*self.taken, self.project(columns, where)))

    def without_prior(self, parameters: IntArray) -> Equations:
        """With these globals not known before."""
        prior, gradient = self.prior.copy(), self.prior_gradient.copy()
        keep = prior[parameters, parameters] * WEAK
        prior[parameters], prior[:, parameters], gradient[parameters] = 0.0, 0.0, gradient[parameters] * WEAK
        prior[parameters, parameters] = keep
        changed = self.base.plus(prior - self.prior, gradient - self.prior_gradient)
        other = replace(
            self,
            prior=prior,
            prior_gradient=gradient,
            model=replace(self.model, plain=changed.covariance(self.free)),
            taken=(),
        )
        return replace(other, taken=tuple(other.project(t.columns, t.where) for t in self.taken))

    def weighed(self) -> Equations:
        """With the excess that its residuals show."""
        return replace(self, excess=pose_excess(self))


@dataclass(frozen=True)
class Score:
    """Outcome of a score test."""

    statistic: float
    plain: float
    """The statistic if pose parts varied as single residuals do."""
    dof: int
    p: float
    estimate: FloatArray
    """(q,)."""
    covariance: FloatArray
    """(q, q)."""
    effect_m: float
    """RMS over the corners concerned of what the clear part of the estimate moves them by, metres."""


def pose_residuals(eq: Equations) -> tuple[FloatArray, FloatArray]:
    """Squares of the views' pose parts (V, parts), and what they would be, m, had views no errors of their own."""
    own, (now, absorbed) = eq.rows, eq.model.pose_parts
    if eq.taken:
        inverse, score, low = eq.of_taken()
        absorbed = absorbed + np.einsum("vdp,pq,vdq->vd", low, inverse, low, optimize=True)
        now = now - low @ (inverse @ score)
    there = (np.any(own.low_globals != 0, axis=2) | np.any(own.low_unit != 0, axis=2)) & eq.shared[:, None]
    return np.where(there, now**2, 0.0), np.where(there, np.clip(1 - absorbed, 0.0, 1.0), 0.0)


def pose_excess(eq: Equations) -> FloatArray:
    """By how much the variance of the views' pose parts exceeds 1, (parts,), from those parts of the weighed residuals.

    One variance for each of the groups: a board that is offset as a whole is another matter than one that is tilted.
    With m = q' M q, E (q' r)^2 = m + excess m^2 but for what parts share, so that the moments give it. Once an error is in the
    model, less may be left than they are weighed by: the excess is negative, down to the variance of single residuals.
    """
    squares, m = pose_residuals(eq)
    out = np.zeros(len(eq.groups))
    for g in np.unique(eq.groups):
        mine = eq.groups == g
        weight = float(np.sum(m[:, mine] ** 2))
        out[mine] = float(squares[:, mine].sum() - m[:, mine].sum()) / weight if weight > 1 else 0.0
    return np.asarray(np.maximum(out, eq.least_excess))


def score_test(
    eq: Equations, columns: IntArray, where: BoolArray, effect: FloatArray | None = None, least_seen: float = SEEN
) -> Score:
    """Would the solution gain by the errors `columns` in the views `where`?

    Parameters
    ----------
    columns : (q,), of possible errors.
    where : (V,) bool.
    effect : (q, q), mean square of the error in metres as a quadratic form of the estimate; None: of `size`.
    least_seen : share of A that M must leave.
    """
    found = eq.within(eq.project(columns, where))
    of_parts = np.einsum("vdp,vdq->dpq", found.low, found.low, optimize=True)
    variance, least = (found.information + np.tensordot(e, of_parts, 1) for e in (eq.excess, eq.least_excess))
    if effect is None:
        size = eq.rows.size[where][:, columns[:, None], columns].sum(axis=0)
        effect = size / max(int(eq.corners[where].sum()), 1)
    scale = np.sqrt(np.maximum(np.diag(found.own), 1e-300))
    return judge(found.score, found.information, variance, least, scale, effect, least_seen)


def judge(
    score: FloatArray,
    information: FloatArray,
    variance: FloatArray,
    least: FloatArray,
    scale: FloatArray,
    effect: FloatArray,
    least_seen: float,
) -> Score:
    """Statistic, estimate and clear effect of a score (q,), directions that the model has already left out; its variance is
    `least` if pose parts vary as single residuals do."""
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    kept = values > least_seen
    if not kept.any():
        return Score(0.0, 0.0, 0, 1.0, np.zeros(len(score)), np.zeros((len(score),) * 2), 0.0)
    U = vectors[:, kept]
    s, (var, least) = U.T @ (score / scale), (U.T @ (v / np.outer(scale, scale)) @ U for v in (variance, least))
    statistic, plain = float(s @ np.linalg.solve(var, s)), float(s @ np.linalg.solve(least, s))
    B = U / values[kept] / scale[:, None]  # estimate = -B s
    estimate, covariance = -B @ s, B @ var @ B.T
    dof = int(kept.sum())
    return Score(statistic, plain, dof, chi2_sf(statistic, dof), estimate, covariance, clear_effect(-s, var, B, effect))


def clear_effect(s: FloatArray, variance: FloatArray, B: FloatArray, effect: FloatArray) -> float:
    """Root of a' E a over the parts of a = B s, s of this variance, that stand out of their noise."""
    L = np.linalg.cholesky(variance)
    y = np.linalg.solve(L, s)
    BL = B @ L
    sizes, axes = np.linalg.eigh(BL.T @ effect @ BL)
    parts = axes.T @ y
    return float(np.sqrt(np.sum((np.maximum(sizes, 0) * parts**2)[np.abs(parts) > CLEAR_SIGMAS])))

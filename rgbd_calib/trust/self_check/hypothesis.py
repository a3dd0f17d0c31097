"""An error that the model lacks, and what the solution says of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rgbd_calib.geometry.linear import BoolArray, IntArray, symmetric_inverse
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.geometry.tails import chi2_sf, f_sf
from rgbd_calib.rig.blocks import Fault, Told
from rgbd_calib.trust.self_check.equations import SEEN, Equations, Score, clear_effect, score_test

OWN_SHARE = 1e-3
"""A deviation from a prior whose variance is a smaller share of the prior's tells nothing: the prior decided it."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """An error that the model lacks, in some views."""

    fault: Fault
    cameras: tuple[str, ...]
    """Empty: of the board, which all see."""
    columns: IntArray
    """Columns of possible errors; of what was known: those of its parameters."""
    where: BoolArray
    """(V,) bool."""
    frame: str = ""
    """From which on; empty where it is not of time."""
    effect: FloatArray | None = None
    """Mean square of the error in metres as a quadratic form of its estimate; None: as the columns have it."""
    least_seen: float = SEEN
    """Share of the columns that must be left by what the model has."""
    parameters: IntArray | None = None
    """Globals of which what was known before is tested; None: an error of the views."""

    @property
    def name(self) -> str:
        return self.fault.check

    def say(self, eq: Equations, score: Score) -> str:
        z = float(np.sqrt(np.average(eq.distance_m[self.where] ** 2, weights=eq.corners[self.where])))
        named = (" or " if self.frame else ", ").join(self.cameras)
        return self.fault.say(Told(score.estimate, score.covariance, score.effect_m, named, self.frame, z))

    def test(self, eq: Equations) -> Score:
        """How much the solution speaks for it."""
        if self.parameters is not None:
            return prior_test(eq, *self._known(eq), self.where)
        return score_test(eq, self.columns, self.where, self.effect, self.least_seen)

    def accepted(self, eq: Equations) -> Equations:
        """The equations with this error in the model."""
        if self.parameters is not None:
            return eq.without_prior(self._known(eq)[0]).weighed()
        return eq.with_error(self.columns, self.where).weighed()

    def retest(self, eq: Equations) -> Score:
        """The same with the views' variances as they are once this error is in the model, by Fisher's distribution.

        An error of one camera scatters all views against each other, and would hide itself behind that scatter. The
        variances of pose parts rest on few views, those of single corners on many: the degrees of freedom are those of
        the mixture (F. Satterthwaite, Biometrics Bulletin 2(6), 1946).
        """
        excess, kind = self.accepted(eq).excess, eq.rows.kind
        score = self.test(replace(eq, excess=excess))
        if not score.dof:
            return score
        total = float(np.trace(score.covariance))
        without = [
            self.test(replace(eq, excess=np.where(kind == k, eq.least_excess, excess))) for k in range(len(eq.dof))
        ]
        shares = np.array([1 - float(np.trace(own.covariance)) / total for own in without])
        dof = 1 / max(float(np.sum(shares**2 / eq.dof)), 1e-6)
        return replace(score, p=f_sf(score.statistic / score.dof, score.dof, dof))

    def _known(self, eq: Equations) -> tuple[IntArray, IntArray]:
        """Globals that are free and known before, and their columns."""
        assert self.parameters is not None
        used = eq.free[self.parameters] & (np.diag(eq.prior)[self.parameters] > 0)
        return self.parameters[used], self.columns[used]


def prior_test(eq: Equations, own: IntArray, columns: IntArray, where: BoolArray) -> Score:
    """What was known of the globals `own` before, against what the recording says of them.

    With theta0 the prior's mean, of information L, theta the estimate, and C, C' its covariance without and with the
    excess: Var(theta - theta0) = C' + L^-1 - 2 C over the parameters concerned.
    """
    nothing = np.zeros((len(own), len(own)))
    if not len(own):
        return Score(0.0, 0.0, 0, 1.0, np.zeros(0), nothing, 0.0)
    at = np.ix_(own, own)
    L_inv = symmetric_inverse(eq.prior[at])
    step, plain, sandwich, least = _of(eq, own)
    d = L_inv @ eq.prior_gradient[own] + step
    variance, least = (v + L_inv - 2 * plain for v in (sandwich, least))
    unit = 1 / np.sqrt(np.diag(L_inv))
    values, vectors = np.linalg.eigh(variance * np.outer(unit, unit))
    kept = values > OWN_SHARE
    if not kept.any():
        return Score(0.0, 0.0, 0, 1.0, d, nothing, 0.0)
    U = vectors[:, kept]
    y, dof = U.T @ (unit * d), int(kept.sum())
    statistic = float(np.sum(y**2 / values[kept]))
    alone = U.T @ (least * np.outer(unit, unit)) @ U
    unscattered = float(y @ np.linalg.lstsq(alone, y, rcond=1e-6)[0])
    size = eq.rows.size[where][:, columns[:, None], columns].sum(axis=0) / max(int(eq.corners[where].sum()), 1)
    effect_m = clear_effect(y, np.diag(values[kept]), U / unit[:, None], size)
    return Score(statistic, unscattered, dof, chi2_sf(statistic, dof), d, variance, effect_m)


def _of(eq: Equations, own: IntArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Of some globals, with what was taken into the model: the step left, and the covariance, by what views are weighed by,
    with the excess, and if pose parts varied as single residuals do."""
    rows, C = eq.rows, eq.plain.of_globals[own]
    step, plain = eq.model.step[0][own], C[:, own]
    low = rows.low_globals @ C.T  # Q' J C, (V, parts, k)
    for k, units in enumerate(rows.units.T):
        parts, cross = rows.kind == k, eq.plain.cross(units)[:, own]
        low[:, parts] += rows.low_unit[:, parts] @ cross.transpose(0, 2, 1)
    if eq.taken:
        inverse, score, of_taken = eq.of_taken()
        reduced = np.concatenate([t.reduced for t in eq.taken], axis=1)
        X = C @ reduced  # (k, E): what the globals absorb of the errors
        step = step + X @ (inverse @ score)
        plain = plain + X @ inverse @ X.T
        low = low - (of_taken @ inverse @ X.T)
    of_parts = np.einsum("vdp,vdq->dpq", low, low, optimize=True)
    sandwich, least = (plain + np.tensordot(e, of_parts, 1) for e in (eq.excess, eq.least_excess))
    return step, plain, sandwich, least

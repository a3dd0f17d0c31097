"""An error that the model lacks, and what the solution says of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2, f

from rgbd_calib.geometry.inverse import symmetric_inverse
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.trust.self_check.equations import SEEN, Equations, Score, clear_effect, score_test
from rgbd_calib.types import IntArray

OWN_SHARE = 1e-3
"""A deviation from a prior whose variance is a smaller share of the prior's tells nothing: the prior decided it."""

Say = Callable[[Score], str]


@dataclass(frozen=True)
class Hypothesis:
    """An error that the model lacks, in some views."""

    name: str
    cameras: tuple[str, ...]
    """Empty: of the board, which all see."""
    columns: IntArray
    """Local columns; of a prior: those of its parameters."""
    where: IntArray
    """(V,) bool."""
    say: Say
    advice: str
    effect: FloatArray | None = None
    """Mean square of the error in metres as a quadratic form of its estimate; None: as the columns have it."""
    least_seen: float = SEEN
    """Share of the columns that must be left by what the model has."""
    of_prior: bool = False
    """Not an error of the views, but of what was known before."""

    def test(self, eq: Equations) -> Score:
        """How much the solution speaks for it."""
        if self.of_prior:
            return prior_test(eq, *self._own(eq), self.where)
        return score_test(eq, self.columns, self.where, self.effect, self.least_seen)

    def accepted(self, eq: Equations) -> Equations:
        """The equations with this error in the model."""
        wider = eq.without_prior(self._own(eq)[0]) if self.of_prior else eq.extended(self.columns, self.where)
        return wider.weighed()

    def retest(self, eq: Equations) -> Score:
        """The same with the views' variances as they are once this error is in the model, by Fisher's distribution.

        An error of one camera scatters all views against each other, and would hide itself behind that scatter. The
        variances of pose parts rest on few views, those of single corners on many: the degrees of freedom are those of
        the mixture (F. Satterthwaite, Biometrics Bulletin 2(6), 1946).
        """
        score = self.test(eq.with_excess(self.accepted(eq).excess))
        if not score.freedom:
            return score
        without = self.test(eq.with_excess(np.zeros_like(eq.excess)))
        share = 1 - float(np.trace(without.covariance) / np.trace(score.covariance))
        freedom = eq.freedom / max(share, 1e-3) ** 2
        return replace(score, p=float(f.sf(score.statistic / score.freedom, score.freedom, freedom)))

    def _own(self, eq: Equations) -> tuple[IntArray, IntArray]:
        """Parameters of a prior, those that are free and known before, and their columns."""
        own = eq.index[np.flatnonzero(self.where)[0], self.columns]
        used = np.asarray(eq.free[own].astype(bool) & (np.diag(eq.prior)[own] > 0))
        return own[used], self.columns[used]


def prior_test(eq: Equations, own: IntArray, columns: IntArray, where: IntArray) -> Score:
    """What was known of the parameters `own` before, against what the recording says of them.

    With theta0 the prior's mean, of information L, theta the estimate, and C, C' its covariance without and with the
    excess: Var(theta - theta0) = C' + L^-1 - 2 C over the parameters concerned.
    """
    nothing = np.zeros((len(own), len(own)))
    if not len(own):
        return Score(0.0, 0.0, 0, 1.0, np.zeros(0), nothing, 0.0)
    at = np.ix_(own, own)
    L_inv = symmetric_inverse(eq.prior[at])
    d = L_inv @ eq.prior_gradient[own] + eq.step[0][own]
    variance = eq.honest_covariance[at] + L_inv - 2 * eq.covariance[at]
    unit = 1 / np.sqrt(np.diag(L_inv))
    values, vectors = np.linalg.eigh(variance * np.outer(unit, unit))
    kept = values > OWN_SHARE
    if not kept.any():
        return Score(0.0, 0.0, 0, 1.0, d, nothing, 0.0)
    U = vectors[:, kept]
    y, freedom = U.T @ (unit * d), int(kept.sum())
    statistic = float(np.sum(y**2 / values[kept]))
    alone = U.T @ ((L_inv - eq.covariance[at]) * np.outer(unit, unit)) @ U
    plain = float(y @ np.linalg.lstsq(alone, y, rcond=1e-6)[0])
    size = eq.size[where][:, columns[:, None], columns].sum(axis=0) / max(int(eq.corners[where].sum()), 1)
    effect_m = clear_effect(y, np.diag(values[kept]), U / unit[:, None], size)
    return Score(statistic, plain, freedom, float(chi2.sf(statistic, freedom)), d, variance, effect_m)

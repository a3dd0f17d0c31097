"""What a minimum says about the noise and about the poses.

In units of the sigmas that the weights used, with the points eliminated, term i brings n_i residuals less three for
each of its points, and the poses' normal matrix N_i; C = (sum_i N_i)^-1. Term i was weighted, within itself, by K (the
robust loss, or the pairs' k / 2), so that its right side has the covariance v_i Q_i, and its residuals see a change of
the poses by the information I_i; for the likelihood N = Q = I. If the variances are v_i (1 where the weights were
right), then

    covariance of the poses    C (sum_i v_i Q_i) C                                              (N^-1 for v = 1)
    mean of term i's squares   sum_j M_ij v_j,   M_ij = tr(C Q_j C I_i) + delta_ij (n_i - 2 tr(C N_i)).

Setting the squares to their means gives unbiased variances whatever the weights were; alternated with the fit, it is
Helmert's and Förstner's estimate, redundancy_i = sum_j M_ij v_j / v_i = n_i - tr(C N_i) for the likelihood. The
relative variances then have covariance W = 2 M^-1, and poses that rest on estimated weights the covariance

    C + 2 Lambda,   Lambda = C [ sum_i W_ii N_i - sum_ij W_ij N_i C N_j ] C,

which matters where a redundancy is small.

References
----------
W. Förstner, B. Wrobel, Photogrammetric Computer Vision, section 4.2.4 (variance components).
M. Kenward, J. Roger, Small sample inference for fixed effects from REML, Biometrics 53(3), 1997 (Lambda).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.biobjective.moments import MomentTerm
from rgbd_calib.rig.biobjective.solver import Term


@dataclass(frozen=True)
class Share:
    """One term at the minimum, in units of the sigma that its weights used."""

    n: float
    """Residuals less three for each point; with a robust loss an observation counts by its weight."""
    squares: float
    """Sum of squares of the (robustly weighted) residuals."""
    N: FloatArray
    Q: FloatArray
    information: FloatArray
    meat: float = 1.0
    """Mean square of a weighted residual of unit noise."""
    slope: float = 1.0
    """Mean derivative of a weighted residual."""


def share(term: Term) -> Share:
    """The term's share; it has been evaluated at the minimum."""
    observations, points = term.grouping.n_observations, len(term.grouping.labels)
    if isinstance(term, MomentTerm):
        N, Q, information = (term.information(power) for power in ((1, 2, 0) if term.pairs else (0, 0, 0)))
        return Share(3.0 * (observations - points), term.sum_of_squares(0), N, Q, information)
    S = term.normal(0.0)[0]
    d = term.dimension
    mean_weight, meat, slope = term.loss.constants(d)
    r, w = term.residuals()
    n = d * float(np.nansum(w)) / mean_weight - 3.0 * points
    squares = float(np.nansum((w[:, None] * r) ** 2))
    return Share(n, squares, S * slope / mean_weight, S * meat / mean_weight, S / mean_weight, meat, slope)


def pose_inverse(shares: list[Share], gauge: FloatArray | None) -> FloatArray:
    """C (6 F, 6 F); with a gauge direction, the inverse among steps without a part along it."""
    N = np.sum([s.N for s in shares], axis=0)
    if gauge is None:
        return _inverse(N)
    strength = np.trace(N) / len(N)
    along = np.outer(gauge, gauge)
    return _inverse(N + strength * along) - along / strength


def mean_squares(shares: list[Share], C: FloatArray) -> FloatArray:
    """M (terms, terms)."""
    M = np.empty((len(shares), len(shares)))
    for i, a in enumerate(shares):
        for j, b in enumerate(shares):
            M[i, j] = a.slope**2 * np.vdot((C @ b.Q @ C).T, a.information)
        M[i, i] += a.meat * (a.n - 2 * np.vdot(C, a.N))
    return M


def variances(shares: list[Share], M: FloatArray, estimated: np.ndarray) -> FloatArray:
    """Relative variances (terms,) whose mean squares are those seen; 1 where not `estimated`.

    Unbiased; where that would make one negative (a redundancy of a few, seen from wrong weights), the positive step of
    the same fixed point instead.
    """
    v = np.ones(len(shares))
    squares = np.array([s.squares for s in shares])
    i = np.flatnonzero(estimated)
    if len(i):
        v[i] = np.linalg.solve(M[np.ix_(i, i)], squares[i] - M[np.ix_(i, np.flatnonzero(~estimated))].sum(axis=1))
        if np.any(v <= 0):
            v[i] = (squares / M.sum(axis=1))[i]
    return v


def covariance(shares: list[Share], C: FloatArray, variances: FloatArray) -> FloatArray:
    """Of the poses (6 F, 6 F), for relative variances (terms,) that are known."""
    meat = np.sum([v * s.Q for s, v in zip(shares, variances, strict=True)], axis=0)
    out: FloatArray = C @ meat @ C
    return (out + out.T) / 2


def small_sample_growth(shares: list[Share], C: FloatArray, W: FloatArray) -> FloatArray:
    """2 Lambda (6 F, 6 F), for weights whose relative variances have the covariance W."""
    inner = np.zeros_like(C)
    for i, a in enumerate(shares):
        inner += W[i, i] * a.N
        for j, b in enumerate(shares):
            inner -= W[i, j] * a.N @ C @ b.N
    out: FloatArray = C @ (inner + inner.T) @ C
    return out


def _inverse(N: FloatArray) -> FloatArray:
    scale = 1.0 / np.sqrt(np.diag(N))
    out: FloatArray = np.linalg.inv(N * scale[:, None] * scale) * scale[:, None] * scale
    return (out + out.T) / 2

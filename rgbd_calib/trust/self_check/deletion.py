"""Frames taken away from a solution, without solving again.

Taking frames away works on the same equations. With the boards eliminated, each frame f adds S_f to the reduced normal
equations S and g_f to their gradient, so that without the frames F

    x_(-F) = x - (S - S_F)^-1 (g - g_F)

which is the deletion formula of linear regression for groups (Cook, Weisberg) and one Gauss-Newton step of a real refit.
At x_(-F) the frames F have the gradient h = g_F + S_F (x_(-F) - x). If all frames are of one rig, its variance is
B_F + S_F Cov_(-F) S_F, B_F the frames' own information with the excess, and h' Var(h)^+ h ~ chi2(rank).

References
----------
R. D. Cook, S. Weisberg, Residuals and Influence in Regression, Chapman and Hall, 1982, chapters 2 and 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from rgbd_calib.geometry.inverse import symmetric_inverse
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.trust.self_check.equations import Equations
from rgbd_calib.types import IntArray


@dataclass(frozen=True)
class Deletion:
    """The solution without some frames, and how well those frames agree with it."""

    step: FloatArray
    """(P,), x_(-F) - x."""
    covariance: FloatArray
    """(P, P), of x_(-F)."""
    statistic: float
    freedom: int
    p: float


def delete(eq: Equations, gone: IntArray) -> Deletion:
    """Take the boards `gone`, (F,) bool, away."""
    S_gone, g_gone = eq.frame_information[gone].sum(axis=0), eq.frame_gradient[gone].sum(axis=0)
    left = symmetric_inverse(eq.information - S_gone) * np.outer(eq.free, eq.free)
    gradient = eq.frame_gradient.sum(axis=0) + eq.prior_gradient * eq.free
    step = -left @ (gradient - g_gone)
    extra = eq.frame_excess
    covariance = left + left @ extra[~gone].sum(axis=0) @ left
    h = g_gone + S_gone @ step
    variance = S_gone + extra[gone].sum(axis=0) + S_gone @ covariance @ S_gone
    scale = 1 / np.sqrt(np.maximum(np.diag(variance), 1e-300))
    values, vectors = np.linalg.eigh(variance * np.outer(scale, scale))
    kept = values > 1e-8 * values[-1]
    statistic = float(np.sum((vectors[:, kept].T @ (scale * h)) ** 2 / values[kept]))
    freedom = int(kept.sum())
    return Deletion(step, covariance, statistic, freedom, float(chi2.sf(statistic, freedom)))

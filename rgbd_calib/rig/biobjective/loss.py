"""Losses of the squared length s^2 of one whitened residual of d components, and their constants for normal noise.

The solver uses the weights w = d rho / d(s^2) (iteratively reweighted least squares). For normal noise, s^2 is
chi-square with d degrees of freedom; three expectations keep the statistics honest:

    mean_weight  e = E[w]                       an observation counts w / e times in the redundancy
    meat         m = E[w^2 s^2] / d             variance of the weighted residual, per component
    bread        b = E[w + (2 / d) s^2 w']      its mean derivative; covariance = (m / b^2) (J^T J)^-1

References
----------
P. Huber, E. Ronchetti, Robust Statistics, 2nd edition, sections 7.6-7.8.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray

LossName = Literal["squared", "huber", "cauchy"]


@dataclass(frozen=True)
class Loss:
    """squared: s^2. huber: linear in s beyond `scale`. cauchy: scale^2 log(1 + s^2 / scale^2)."""

    name: LossName = "squared"
    scale: float = 2.5
    """In sigmas. At 2.5 either loss costs about 5 % of efficiency or less where the noise is normal."""

    @property
    def is_squared(self) -> bool:
        return self.name == "squared"

    def __call__(self, s2: FloatArray) -> tuple[float, FloatArray]:
        """Sum of rho, and the weights, of s2 (...)."""
        c2 = self.scale**2
        if self.name == "huber":
            s = np.sqrt(s2)
            outside = s2 > c2
            w = np.where(outside, self.scale / np.where(outside, s, 1.0), 1.0)
            return float(np.sum(np.where(outside, 2 * self.scale * s - c2, s2))), w
        if self.name == "cauchy":
            return float(c2 * np.sum(np.log1p(s2 / c2))), 1.0 / (1.0 + s2 / c2)
        return float(np.sum(s2)), np.ones_like(s2)

    def constants(self, d: int) -> tuple[float, float, float]:
        """mean_weight, meat and bread for d components of normal noise."""
        return _constants(self, d)


@lru_cache
def _constants(loss: Loss, d: int) -> tuple[float, float, float]:
    if loss.is_squared:
        return 1.0, 1.0, 1.0
    from scipy.stats import chi2

    s2 = chi2.ppf((np.arange(200_000) + 0.5) / 200_000, d)  # midpoints of equal probability: error about 1e-5
    _, w = loss(s2)
    slope = np.where(w < 1, -w / (2 * s2), 0.0) if loss.name == "huber" else -(w**2) / loss.scale**2
    return float(w.mean()), float(np.mean(w * w * s2) / d), float(np.mean(w + 2 / d * s2 * slope))

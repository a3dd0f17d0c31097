"""Tukey's biweight (A. Beaton, J. Tukey, Technometrics 16(2), 1974), and the scale of residuals that it counts in."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.linear import BoolArray
from rgbd_calib.geometry.so3 import FloatArray

LIMIT = 4.7
"""Deviations from which on a row counts nothing: 95 % efficient for normal errors."""
MEDIAN_OF_SIZE = {1: 0.6745, 2: 0.8326}
"""Of the RMS of so many normal coordinates, in deviations."""
FEWEST = 6
"""Rows that tell a scale."""


def scale(size: FloatArray, coordinates: int, least: float, near: BoolArray | None = None) -> float:
    """Deviation of the errors of which rows have the RMS `size` (n,) of so many coordinates; at first by those that are `near` (n,)."""
    kept = np.ones(len(size), bool) if near is None else near
    sigma = np.inf
    for _ in range(4):  # again without what is far out
        sigma = max(float(np.median(size[kept])) / MEDIAN_OF_SIZE[coordinates], least)
        kept = size < LIMIT * sigma
        if np.count_nonzero(kept) < FEWEST:
            break
    return sigma


def weights(size: FloatArray, sigma: float) -> tuple[FloatArray, FloatArray]:
    """u (n,), the squares of sizes over those that count nothing, and the weights (1 - u)^2."""
    u = np.minimum((size / (LIMIT * sigma)) ** 2, 1.0)
    return u, (1 - u) ** 2

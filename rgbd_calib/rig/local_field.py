"""What a depth sensor errs by over its image, beyond the smooth field: cells, steps, ripples, from the walls alone.

With the smooth field (:mod:`.blocks.depth_field`) and all else as solved, what is left at a cell of the image in the walls of
one camera, over z^p, is a pattern f plus noise. The mean over the walls has the noise that their scatter says. It is filtered
in the frequencies of the image, each band by its signal's share of its power (N. Wiener, 1949, with the spectrum estimated
from the data): where there is no pattern nothing is left, and where there is one its noise is not taken for it. p is the power
that leaves the least. Patterns this fine have no part in where cameras stand; so they are estimated between the rounds, and
are known while the rest is solved.
"""

from __future__ import annotations

import numpy as np
from scipy.fft import dctn, idctn

from rgbd_calib.geometry.depth_error import CellPattern
from rgbd_calib.geometry.linear import BoolArray
from rgbd_calib.geometry.so3 import FloatArray

POWERS = (0, 1, 2)
LEAST_WALLS = 4
"""Below, their scatter does not tell noise from pattern."""
BANDS = 12
"""Of spatial frequency: the spectrum is smooth."""
LEAST_SEEN = 0.5
"""Share of the walls in which a cell must be seen."""


def local_field(left_m: FloatArray, depth_m: FloatArray, seen: BoolArray) -> CellPattern | None:
    """The pattern of one camera.

    Parameters
    ----------
    left_m : (walls, rows, columns), true less corrected depth.
    depth_m : (walls, rows, columns), as reported.
    """
    if len(left_m) < LEAST_WALLS:
        return None
    best: tuple[float, CellPattern] | None = None
    for power in POWERS:
        w = np.where(seen, depth_m ** (2.0 * power - 4.0), 0.0)  # noise of z^2 in units of z^p
        q = left_m / np.where(seen, depth_m, 1.0) ** power
        total = w.sum(axis=0)
        known = (seen.mean(axis=0) >= LEAST_SEEN) & (total > 0)
        if not known.any():
            return None
        mean = np.where(known, np.sum(w * q, axis=0) / np.where(known, total, 1.0), 0.0)
        scatter = np.sum(w * (q - mean) ** 2 * known) / max(int((seen & known).sum() - known.sum()), 1)
        noise = scatter / np.where(known, total, np.inf)  # variance of the mean, by cell
        values = _filtered(mean, float(noise[known].mean()))
        left = float(np.sum((left_m - values * depth_m**power) ** 2 * np.where(seen, depth_m**-4.0, 0.0)))
        if best is None or left < best[0]:
            best = left, CellPattern(power, values)
    return None if best is None else best[1]


def _filtered(mean: FloatArray, noise: float) -> FloatArray:
    """The part of `mean` (rows, columns) that stands out of white noise of this variance."""
    rows, columns = mean.shape
    spectrum = dctn(mean, norm="ortho")
    frequency = np.hypot(*np.meshgrid(np.arange(rows) / rows, np.arange(columns) / columns, indexing="ij"))
    band = np.minimum((frequency / frequency.max() * BANDS).astype(int), BANDS - 1)
    power = np.bincount(band.ravel(), spectrum.ravel() ** 2) / np.bincount(band.ravel())
    share = np.clip(1 - noise / np.maximum(power, 1e-300), 0.0, 1.0)
    return np.asarray(idctn(spectrum * share[band], norm="ortho"))

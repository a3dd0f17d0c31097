"""Inverses of covariances and informations."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray


def symmetric_inverse(A: FloatArray) -> FloatArray:
    """Pseudo-inverse (n, n) of a positive semidefinite matrix (n, n) of parameters of any units.

    Scaled to a unit diagonal first: what a pseudo-inverse takes for zero is measured against the largest eigenvalue, and
    the information of a focal length in pixels is 1e-16 of that of a curvature in 1/m. Rows of zeros stay zero.
    """
    diagonal = np.diag(A)
    scale = np.where(diagonal > 0, 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), 0.0)
    unit = np.linalg.pinv(A * np.outer(scale, scale), rcond=1e-12, hermitian=True)
    return np.asarray(unit * np.outer(scale, scale), float)

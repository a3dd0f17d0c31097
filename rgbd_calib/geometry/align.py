"""Rigid alignment of two point sets (closed form)."""

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray


def rigid(p_a: FloatArray, p_b: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """T_a_b (4, 4) that minimises sum of w |p_a - T_a_b p_b|^2 over points (n, 3), metres, n >= 3, not collinear.

    S. Umeyama, IEEE PAMI 13(4), 1991, without the scale.
    """
    w = np.ones(len(p_a)) if weights is None else weights
    mean_a, mean_b = (np.average(p, axis=0, weights=w) for p in (p_a, p_b))
    U, _, Vt = np.linalg.svd((w[:, None] * (p_a - mean_a)).T @ (p_b - mean_b))
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R_a_b = U @ D @ Vt
    return se3.make(R_a_b, mean_a - R_a_b @ mean_b)

"""Rotations as 3x3 matrices; exponential and logarithm by scipy's Rotation.

References
----------
Sola, Deray, Atchuthan: A micro Lie theory for state estimation in robotics, arXiv:1812.01537.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

FloatArray = NDArray[np.float64]


def exp(rotvec_rad: FloatArray) -> FloatArray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), rad."""
    rotvec_rad = np.asarray(rotvec_rad, float)
    flat = Rotation.from_rotvec(rotvec_rad.reshape(-1, 3)).as_matrix()
    return flat.reshape(*rotvec_rad.shape[:-1], 3, 3)


def log(R: FloatArray) -> FloatArray:
    """Rotation vectors (..., 3), rad, of rotation matrices (..., 3, 3); length at most pi."""
    R = np.asarray(R, float)
    return Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(R.shape[:-1])


def angle_rad(R: FloatArray) -> FloatArray:
    """Angles (...), rad in [0, pi], of rotation matrices (..., 3, 3)."""
    R = np.asarray(R, float)
    sines = [R[..., i, j] - R[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))]
    # twice the sine and the cosine: their quotient is precise at every angle
    return np.arctan2(np.sqrt(sum(s * s for s in sines)), np.trace(R, axis1=-2, axis2=-1) - 1)


def hat(v: FloatArray) -> FloatArray:
    """Skew matrices (..., 3, 3) of vectors (..., 3): ``hat(v) @ p == cross(v, p)``."""
    v = np.asarray(v, float)
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def quaternion_wxyz(R: FloatArray) -> FloatArray:
    """Unit quaternion (4,), (w, x, y, z) with w >= 0, of a rotation matrix (3, 3)."""
    return Rotation.from_matrix(R).as_quat(canonical=True, scalar_first=True)


def of_quaternion(wxyz: FloatArray) -> FloatArray:
    """Rotation matrix (3, 3) of a quaternion (4,), (w, x, y, z), of any length but zero."""
    return Rotation.from_quat(wxyz, scalar_first=True).as_matrix()


def mean(R: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """Mean (3, 3) of rotation matrices (n, 3, 3), in the chordal metric (safe near half turns)."""
    return Rotation.from_matrix(R).mean(weights).as_matrix()

"""OpenCV's fisheye lens: with (x, y) = (X / Z, Y / Z), r = hypot(x, y), theta = atan r,

    theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)         (x_d, y_d) = (x, y) theta_d / r

References
----------
J. Kannala, S. Brandt, A generic camera model and calibration method, IEEE PAMI 28(8), 2006; OpenCV, fisheye.
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray

SIZES = (4,)
_NEAR_AXIS = 1e-8


def distort(k: FloatArray, xy: FloatArray) -> FloatArray:
    """Distorted coordinates (..., 2) of undistorted ones (..., 2); `k` (4,) or (..., 4)."""
    r = np.hypot(xy[..., 0], xy[..., 1])
    theta_d, _, _ = _angle(k, r)
    scale = np.where(r > _NEAR_AXIS, theta_d / np.maximum(r, _NEAR_AXIS), 1.0)
    return xy * scale[..., None]


def distort_jacobian(
    k: FloatArray, xy: FloatArray, by_coefficients: bool = True
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distorted coordinates (..., 2), and their derivatives (..., 2, 2) by the undistorted and (..., 2, 4) by `k`.

    Without `by_coefficients` the last is empty, (..., 2, 0).
    """
    r = np.hypot(xy[..., 0], xy[..., 1])
    theta_d, slope, by_k = _angle(k, r)
    off_axis, safe = r > _NEAR_AXIS, np.maximum(r, _NEAR_AXIS)
    scale = np.where(off_axis, theta_d / safe, 1.0)
    along = xy / safe[..., None]
    # across the radius the point is scaled by theta_d / r, along it by d theta_d / d r
    by_xy = scale[..., None, None] * np.eye(2) + np.where(off_axis, slope - scale, 0.0)[..., None, None] * (
        along[..., :, None] * along[..., None, :]
    )
    by_k = np.where(off_axis[..., None], by_k, 0.0)[..., : 4 if by_coefficients else 0]
    return xy * scale[..., None], by_xy, along[..., :, None] * by_k[..., None, :]


def radial(k: FloatArray, r: FloatArray) -> FloatArray:
    """Distorted radius (m,) of undistorted radii (m,)."""
    return _angle(k, r)[0]


def _angle(k: FloatArray, r: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """theta_d, its derivative by r, and by k (..., 4)."""
    theta = np.arctan(r)
    t2 = theta * theta
    k1, k2, k3, k4 = np.moveaxis(np.asarray(k, float), -1, 0)
    theta_d = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    by_theta = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + 9 * t2 * k4)))
    powers = np.stack([theta * t2, theta * t2**2, theta * t2**3, theta * t2**4], axis=-1)
    return theta_d, by_theta / (1 + r * r), powers

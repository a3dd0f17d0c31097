"""The distance to a wall in a depth image, along the optical axis."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray

MIN_VALID_SHARE = 0.2
CENTRE_SHARE = 0.6
"""Width and height of the part of the image that is used: the wall must fill it."""
HUBER_SIGMAS = 2.0


def wall_depth(depth_m: FloatArray, centre_px: tuple[float, float]) -> float:
    """Depth reported at the principal point, metres, by a robust plane through the middle of the image.

    1/z of a plane is affine in the pixel; the fit is iterated with Huber's weights, so that furniture at the border and
    a wall not quite square to the camera do not matter. NaN where the depth image has too few measurements.
    """
    h, w = depth_m.shape
    du, dv = int(w * CENTRE_SHARE / 2), int(h * CENTRE_SHARE / 2)
    v, u = np.mgrid[h // 2 - dv : h // 2 + dv, w // 2 - du : w // 2 + du]
    q = 1.0 / depth_m[v, u].ravel()
    valid = np.isfinite(q)
    if valid.mean() < MIN_VALID_SHARE:
        return float("nan")
    q = q[valid]
    A = np.column_stack([(u.ravel()[valid] - centre_px[0]) / w, (v.ravel()[valid] - centre_px[1]) / h, np.ones(len(q))])
    near = np.abs(q - np.median(q)) < 0.1 * np.median(q)
    A, q = A[near], q[near]
    weights = np.ones(len(q))
    for _ in range(10):
        plane = np.linalg.solve(A.T @ (weights[:, None] * A), A.T @ (weights * q))
        residual = np.abs(q - A @ plane)
        scale = 1.4826 * float(np.median(residual)) + 1e-12
        weights = np.minimum(1.0, HUBER_SIGMAS * scale / np.maximum(residual, 1e-15))
    return float(1.0 / plane[2])

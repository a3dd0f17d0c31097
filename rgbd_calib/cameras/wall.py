"""The distance to a wall in a depth image, along the optical axis."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray

MIN_VALID_SHARE = 0.2
CENTRE_SHARE = 0.6
"""Width and height of the part of the image that is used: the wall must fill it."""
CLIP_SIGMAS = 4.0


PATCHES = 6
"""Patches along each side, from whose scatter the standard error comes: noise inside a patch may be correlated."""


def wall_depth(depth_m: FloatArray, centre_px: tuple[float, float]) -> tuple[float, float]:
    """Depth reported at the principal point and its standard error, metres, by a robust plane through the middle.

    1/z of a plane is affine in the pixel; the fit is repeated without what is far off it, so that furniture at the border and
    a wall not quite square to the camera do not matter. NaN where the depth image has too few measurements.
    """
    h, w = depth_m.shape
    du, dv = int(w * CENTRE_SHARE / 2), int(h * CENTRE_SHARE / 2)
    v, u = np.mgrid[h // 2 - dv : h // 2 + dv, w // 2 - du : w // 2 + du]
    q = 1.0 / depth_m[v, u].ravel()
    valid = np.isfinite(q)
    if valid.mean() < MIN_VALID_SHARE:
        return float("nan"), float("nan")
    q = q[valid]
    patch = (PATCHES * (v - v.min()) // (2 * dv) * PATCHES + PATCHES * (u - u.min()) // (2 * du)).ravel()[valid]
    A = np.column_stack([(u.ravel()[valid] - centre_px[0]) / w, (v.ravel()[valid] - centre_px[1]) / h, np.ones(len(q))])
    near = np.abs(q - np.median(q)) < 0.1 * np.median(q)
    A, q, patch = A[near], q[near], patch[near]
    keep = np.ones(len(q), bool)
    for _ in range(10):
        kept = A[keep]
        plane = np.linalg.solve(kept.T @ kept, kept.T @ q[keep])  # columns within 1: well conditioned
        residual = q - A @ plane
        # the scatter of what is kept, not a median: most pixels may share one step of the disparity
        again = np.abs(residual) < CLIP_SIGMAS * (float(np.std(residual[keep])) + 1e-12)
        if np.array_equal(again, keep):
            break
        keep = again
    count = np.bincount(patch[keep])
    means = np.bincount(patch[keep], residual[keep])[count > 0] / count[count > 0]
    error = np.sqrt(np.sum(means**2) / max(len(means) - 3, 1) / len(means))
    return float(1.0 / plane[2]), float(error / plane[2] ** 2)

"""Planes n . p = d, |n| = 1, through points in metres."""

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray


def fit(points_m: FloatArray) -> tuple[FloatArray, float]:
    """Normal (3,) and offset d, metres, of the total least squares plane through points (n, 3), n >= 3."""
    mean = points_m.mean(axis=0)
    normal = np.linalg.svd(points_m - mean, full_matrices=False)[2][2]
    return normal, float(normal @ mean)


def ransac(
    points_m: FloatArray, threshold_m: float | FloatArray, rng: np.random.Generator, rounds: int = 200
) -> tuple[FloatArray, float, np.ndarray]:
    """Plane of most points: normal (3,), offset d in metres, inliers (n,) bool.

    Three points make a hypothesis, points nearer than `threshold_m` (one, or one for each point) are its inliers;
    the best is fitted again to all its inliers. M. Fischler, R. Bolles, CACM 24(6), 1981.
    """
    n = len(points_m)
    sample = points_m[np.argsort(rng.random((rounds, n)), axis=1)[:, :3]]
    normals = np.cross(sample[:, 1] - sample[:, 0], sample[:, 2] - sample[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 0] / lengths[lengths > 0, None]
    if not len(normals):
        raise ValueError("every sample of three points is collinear")
    distance = np.abs(normals @ points_m.T - np.sum(normals * sample[lengths > 0, 0], axis=1)[:, None])
    inliers = distance[np.argmax(np.sum(distance < threshold_m, axis=1))] < threshold_m
    for _ in range(3):
        normal, d = fit(points_m[inliers])
        again = np.abs(points_m @ normal - d) < threshold_m
        if np.array_equal(again, inliers) or again.sum() < 3:
            break
        inliers = again
    return normal, d, inliers

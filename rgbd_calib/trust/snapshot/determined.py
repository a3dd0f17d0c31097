"""Which directions of a camera's motion a scene determines, and how to name the others."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.trust.snapshot.motion import Motion

_NAMES = (
    "rotation about x (tilt)",
    "rotation about y (pan)",
    "rotation about z (roll)",
    "translation along x (sideways)",
    "translation along y (vertical)",
    "translation along z (forward)",
)
_PART = 0.35
"""A component of this share of a direction's length is named."""
_GRID = (5, 4)
_CLEAR_SIGMAS, _TRADES = 4.0, 0.9
"""A drift is named from so many deviations on; a correlation above this is a trade."""


def working_points(lens: Intrinsics, distance_m: float) -> FloatArray:
    """Points (20, 3), metres, over the image at this distance, in the camera's frame."""
    u, v = ((np.arange(n) + 0.5) / n * size - 0.5 for n, size in zip(_GRID, (lens.width, lens.height), strict=True))
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    points = lens.rays(pixels) * distance_m
    return points[np.isfinite(points).all(axis=1)]


def displacement_m(T_old_new: FloatArray, covariance: FloatArray, points_m: FloatArray) -> tuple[float, float]:
    """RMS distance by which a motion moves points (n, 3), and the deviation of that distance's noise (RMS)."""
    moved = se3.transform(T_old_new, points_m) - points_m
    J = se3.by_motion(points_m)
    variance = np.einsum("nij,jk,nik->n", J, covariance, J)
    return float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))), float(np.sqrt(variance.mean()))


def free_directions(covariance: FloatArray, distance_m: float, limit_m: float) -> tuple[str, ...]:
    """Directions of the motion whose deviation at this distance is above the limit, the worst first.

    Rotations count by what they move at the distance, so that all six components are lengths.
    """
    scale = np.concatenate([np.full(3, distance_m), np.ones(3)])
    values, vectors = np.linalg.eigh(covariance * np.outer(scale, scale))
    out = []
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        if np.sqrt(max(value, 0)) > limit_m:
            parts = [k for k in np.argsort(-np.abs(vector)) if abs(vector[k]) > _PART]
            out.append(" with ".join(_NAMES[k] for k in parts))
    return tuple(out)


def drift_sentence(motion: Motion) -> str:
    """The drift of the depth between the snapshots, where it is more than noise; empty where it is not.

    Where it trades places with the motion, both are named together.
    """
    sigmas = np.abs(motion.drift[:2]) / np.maximum(motion.drift_sd[:2], 1e-12)
    if sigmas.max() < _CLEAR_SIGMAS:
        return ""
    offset_mm, scale = 1e3 * motion.drift[0], 100 * motion.drift[1]
    at_mm = 1e3 * (motion.drift[0] + 2 * motion.drift[1])
    text = f"depth changed by {at_mm:+.1f} mm at 2 m (offset {offset_mm:+.1f} mm, scale {scale:+.2f} %)"
    together = [_NAMES[k] for k in range(6) if np.abs(motion.correlation[k, :2]).max() > _TRADES]
    return text + (f"; cannot be distinguished from {' and '.join(together)}" if together else "")

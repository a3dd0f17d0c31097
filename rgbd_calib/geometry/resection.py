"""The pose of a camera from points of known position: by the DLT, or, on a plane, by its homography.

DLT: with X = (x, y, z, 1) and the ray m of the same point, m x (P X) = 0 is linear in the 12 entries of
P = s [R | t]; P is the null vector of the stacked equations. P has 11 degrees of freedom and a pose has 6: the
rotation is the one nearest to P's left 3x3 block, and t is solved again with it, which is linear too.

Four points of a plane, or more, leave P a family of solutions, so that flat point sets are refused here: the
homography is for them. Its pose has two candidates whenever perspective is weak; both are returned.

References
----------
R. Hartley, A. Zisserman, Multiple View Geometry, 2nd edition, algorithm 7.1 and section 7.2.
T. Collins, A. Bartoli, Infinitesimal plane-based pose estimation, IJCV 109(3), 2014 (the planar pose).
"""

from __future__ import annotations

import cv2
import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.so3 import FloatArray

MIN_DLT_POINTS = 6
"""11 unknowns, 2 equations from each point."""

MIN_FLATNESS = 0.02
"""Least thickness of the point set over its greatest extent (ratio of its singular values). A camera 2 m from points
spread over 1 m sees the perspective of a thickness of 2 % at about 1 % of their spread: 3 px at 640 x 480, barely more
than noise in the points makes of a plane."""

MIN_RECIPROCAL_CONDITION = 1e-4
"""Least ratio of the last but one to the first singular value of the normalised DLT matrix. Where it is smaller, a
perturbation of the data comes back in P more than 10^4 times as large."""


def dlt(points_m: FloatArray, rays: FloatArray) -> FloatArray:
    """T_color_points (4, 4) from points (n, 3), metres, and their rays (n, 3) with z = 1, n >= 6, not coplanar.

    Raises
    ------
    CalibrationError
        Too few points, values that are not finite, points on a line or in a plane, or a matrix worse conditioned than
        `MIN_RECIPROCAL_CONDITION`. The message does not know the camera: the caller puts its name in front.
    """
    _check(points_m, rays, MIN_DLT_POINTS, "DLT")
    centre, spread = _spread(points_m)
    if spread[1] < MIN_FLATNESS * spread[0]:
        raise CalibrationError(
            f"DLT pose: the {len(points_m)} points are collinear (width over length {spread[1] / spread[0]:.2g}, "
            f"{MIN_FLATNESS:g} needed). Use points spread over the volume that the camera sees"
        )
    if spread[2] < MIN_FLATNESS * spread[0]:
        raise CalibrationError(
            f"DLT pose: the {len(points_m)} points are coplanar (thickness over extent {spread[2] / spread[0]:.2g}, "
            f"{MIN_FLATNESS:g} needed). Pool several board poses, or use the homography of the plane"
        )
    scale = np.sqrt(3.0) / np.sqrt(np.mean(np.sum((points_m - centre) ** 2, axis=1)))
    X = np.concatenate([(points_m - centre) * scale, np.ones((len(points_m), 1))], axis=1)
    mean_ray = rays[:, :2].mean(axis=0)
    ray_scale = np.sqrt(2.0) / np.sqrt(np.mean(np.sum((rays[:, :2] - mean_ray) ** 2, axis=1)))
    u, v = ((rays[:, :2] - mean_ray) * ray_scale).T
    zero = np.zeros_like(X)
    D = np.concatenate([np.hstack([X, zero, -u[:, None] * X]), np.hstack([zero, X, -v[:, None] * X])])
    _, s, Vt = np.linalg.svd(D, full_matrices=False)
    if s[10] < MIN_RECIPROCAL_CONDITION * s[0]:
        raise CalibrationError(
            f"DLT pose: the {len(points_m)} points do not determine a camera (reciprocal condition {s[10] / s[0]:.1g}, "
            f"{MIN_RECIPROCAL_CONDITION:g} needed). Use points at more depths, and more of them"
        )
    undo_rays = np.array([[1 / ray_scale, 0, mean_ray[0]], [0, 1 / ray_scale, mean_ray[1]], [0, 0, 1]])
    P = undo_rays @ Vt[11].reshape(3, 4)
    P *= np.sign(np.sum((X @ P.T)[:, 2])) or 1.0  # most points in front of the camera
    U, _, Wt = np.linalg.svd(P[:, :3])
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Wt)]) @ Wt
    return se3.make(R, _translation(points_m @ R.T, rays))


def homography_pose(points_on_plane_m: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Candidate poses T_color_plane (c, 4, 4), c = 1 or 2, and their RMS (c,) in ray units, the better one first.

    Points (n, 2), metres, lie in the plane z = 0 of their frame; rays (n, 3) have z = 1; n >= 4. Where the second RMS
    is not clearly larger than the first, the pose is ambiguous and something else must choose.

    Raises
    ------
    CalibrationError
        Fewer than four points, values that are not finite, or points on a line.
    """
    points_m = np.column_stack([points_on_plane_m, np.zeros(len(points_on_plane_m))])
    _check(points_m, rays, 4, "homography")
    _, spread = _spread(points_m)
    if spread[1] < MIN_FLATNESS * spread[0]:
        raise CalibrationError(
            f"homography pose: the {len(points_m)} points are collinear (width over length "
            f"{spread[1] / spread[0]:.2g}, {MIN_FLATNESS:g} needed). Use views that show more of the board"
        )
    _, rvecs, tvecs, _ = cv2.solvePnPGeneric(
        points_m, np.ascontiguousarray(rays[:, :2]), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    poses = []
    for rvec, tvec in zip(rvecs, tvecs, strict=True):
        rvec, tvec = cv2.solvePnPRefineLM(points_m, np.ascontiguousarray(rays[:, :2]), np.eye(3), None, rvec, tvec)
        poses.append(se3.make(so3.exp(np.asarray(rvec, float).ravel()), np.asarray(tvec, float).ravel()))
    rms = np.array([_rms(T, points_m, rays) for T in poses])
    order = np.argsort(rms)
    return np.stack(poses)[order], rms[order]


def _translation(rotated_m: FloatArray, rays: FloatArray) -> FloatArray:
    """t (3,) that puts the points R x (n, 3) onto their rays: m x (R x + t) = 0 in least squares."""
    u, v = rays[:, 0], rays[:, 1]
    one, zero = np.ones_like(u), np.zeros_like(u)
    A = np.concatenate([np.stack([one, zero, -u], 1), np.stack([zero, one, -v], 1)])
    b = np.concatenate([u * rotated_m[:, 2] - rotated_m[:, 0], v * rotated_m[:, 2] - rotated_m[:, 1]])
    t: FloatArray = np.linalg.lstsq(A, b, rcond=None)[0]
    return t


def _rms(T_color_points: FloatArray, points_m: FloatArray, rays: FloatArray) -> float:
    p = se3.transform(T_color_points, points_m)
    return float(np.sqrt(np.mean(np.sum((p[:, :2] / p[:, 2:] - rays[:, :2]) ** 2, axis=1))))


def _spread(points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centre (3,) and singular values (3,) of the centred points."""
    centre = points_m.mean(axis=0)
    return centre, np.linalg.svd(points_m - centre, compute_uv=False)


def _check(points_m: FloatArray, rays: FloatArray, least: int, what: str) -> None:
    if len(points_m) < least:
        raise CalibrationError(f"{what} pose: {len(points_m)} points, {least} needed. Record more of them")
    if not (np.all(np.isfinite(points_m)) and np.all(np.isfinite(rays))):
        raise CalibrationError(f"{what} pose: a point or a ray is not finite. Leave such features out")

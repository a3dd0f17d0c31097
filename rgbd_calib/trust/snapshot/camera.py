"""The motion of one camera between two snapshots of the same scene, by itself: against its own old images.

features -> consensus by pixels -> candidates, the camera at rest among them -> the one that most of the depth agrees with
-> tracked corners and patches of depth together -> covariance, free directions
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.trust.snapshot import pixels
from rgbd_calib.trust.snapshot.motion import Motion, Tracks, fit_motion
from rgbd_calib.trust.snapshot.pixels import Matches
from rgbd_calib.trust.snapshot.surfaces import Surface
from rgbd_calib.types import CameraSnapshot, RigCamera

_CONSENSUS_PX = 2.0
_LEAST_MATCHES = 12
_CANDIDATES = 3
_AGREES_M, _AGREES_SIGMAS = 0.004, 4.0
_AGREES_PX = 1.5


class Before:
    """A camera's old snapshot, ready to be compared; monitors keep it."""

    def __init__(self, camera: RigCamera, snapshot: CameraSnapshot) -> None:
        self.camera = camera
        self.surface = Surface(camera, snapshot)
        self.grey = pixels.grey(snapshot.color)


@dataclass(frozen=True)
class CameraMotion:
    """What one camera did between two snapshots."""

    camera: str
    motion: Motion
    unchanged_share: float
    """Share of the patches seen in both that lie where they lay."""
    rival_share: float
    """The same for the best motion that is clearly another one; 0 where there is none."""
    agreeing: int
    """Patches and tracks that the estimate rests on."""


def camera_motion(name: str, before: Before, snapshot: CameraSnapshot) -> CameraMotion:
    """The motion of a camera from its old to its new snapshot."""
    after = Before(before.camera, snapshot)
    lens = before.camera.intrinsics
    matches = pixels.match_features(before.grey, after.grey)
    at = ColorLookup(before.surface, lens)
    found, points = at.points(matches.old_px)
    starts = [np.eye(4), *_consensus(points, matches.only(found), lens)]
    scored = [(_support(before.surface, after.surface, T), T) for T in starts]
    best = max(range(len(scored)), key=lambda k: scored[k][0][0])
    corner_px = pixels.corners(before.grey)
    found, corner_m = at.points(corner_px)
    corner_px = corner_px[found]
    motion = _refined(before, after, corner_px, corner_m, scored[best][1])
    motion = _refined(before, after, corner_px, corner_m, motion.T_old_new)
    share, count = _support(before.surface, after.surface, motion.T_old_new, motion.drift)
    rivals = [s[0] for s, T in scored if _apart(T, motion.T_old_new)]
    return CameraMotion(name, motion, share, max(rivals, default=0.0), count + int(motion.tracks.rows))


class ColorLookup:
    """The surface point at a pixel of the colour image."""

    def __init__(self, surface: Surface, lens: Intrinsics) -> None:
        self._surface, self._lens = surface, lens
        h, w = surface.shape
        # cells of some depth pixels, so that none inside the depth image is empty
        self._cell_px = 3.0 * max(lens.width / w, lens.height / h)
        p = surface.points_m.reshape(-1, 3)
        index = np.flatnonzero(np.isfinite(p).all(axis=1) & (p[:, 2] > 0.05))
        at = np.floor(lens.project(p[index]) / self._cell_px).astype(int)
        self._size = np.ceil(np.array([lens.width, lens.height]) / self._cell_px).astype(int)
        inside = np.all((at >= 0) & (at < self._size), axis=1)
        index, at = index[inside], at[inside]
        order = np.argsort(-p[index, 2], kind="stable")  # the nearest is written last
        self._pixel = np.full((self._size[1], self._size[0]), -1)
        self._pixel[at[order, 1], at[order, 0]] = index[order]

    def points(self, pixels_px: FloatArray) -> tuple[np.ndarray, FloatArray]:
        """Which of pixels (n, 2) lie on a flat patch (m,), and where (m, 3), metres, in the colour camera's frame."""
        cell = np.clip(np.floor(pixels_px / self._cell_px).astype(int), 0, self._size - 1)
        index = self._pixel[cell[:, 1], cell[:, 0]]
        which = np.flatnonzero(index >= 0)
        w = self._surface.shape[1]
        at = np.stack([index[which] % w, index[which] // w], axis=1)
        rays = self._lens.rays(pixels_px[which])
        points = np.zeros((len(which), 3))
        ok = np.ones(len(which), bool)
        for _ in range(2):  # the patch about the cell's point, then about the point itself
            planes = self._surface.patches(at)
            down = np.einsum("ni,ni->n", planes.normals, rays)
            z = np.einsum("ni,ni->n", planes.normals, planes.points_m) / np.where(np.abs(down) > 1e-6, down, 1e-6)
            points = z[:, None] * rays
            ok = planes.good & (z > 0.05)
            at, inside = self._surface.pixels_of(points)
            ok &= inside
        return which[ok], points[ok]


def _consensus(points_m: FloatArray, matches: Matches, lens: Intrinsics) -> list[FloatArray]:
    """Motions (4, 4) that many matches agree on, the largest consensus first."""
    out: list[FloatArray] = []
    rays = lens.rays(matches.new_px)[:, :2] * lens.fx
    K = np.diag([lens.fx, lens.fx, 1.0])
    left = np.arange(len(points_m))
    while len(left) >= _LEAST_MATCHES and len(out) < _CANDIDATES:
        ok, rvec, tvec, inliers = cv2.solvePnPRansac(
            points_m[left], rays[left], K, None,
            iterationsCount=500, reprojectionError=_CONSENSUS_PX, confidence=0.9999, flags=cv2.SOLVEPNP_AP3P,
        )  # fmt: skip
        if not ok or inliers is None or len(inliers) < _LEAST_MATCHES:
            break
        T_new_old = se3.make(so3.exp(np.ravel(rvec)), np.ravel(tvec))
        out.append(se3.inverse(T_new_old))
        left = np.delete(left, inliers.ravel())
    return out


def _support(old: Surface, new: Surface, T_old_new: FloatArray, drift: FloatArray | None = None) -> tuple[float, int]:
    """Share and number of the patches seen in both depth images that agree with a motion."""
    grid = old.grid()
    planes = old.patches(grid)
    planes = planes.only(planes.good)
    pixels_new, inside = new.pixels_of(se3.transform(se3.inverse(T_old_new), planes.points_m))
    planes, there = planes.only(inside), new.patches(pixels_new[inside])
    measured = np.isfinite(new.points_m[pixels_new[inside][:, 1], pixels_new[inside][:, 0]]).all(axis=1)
    points = there.points_m
    if drift is not None:
        points = points * (1 + (drift[0] + drift[1] * points[:, 2]) / np.maximum(points[:, 2], 0.1))[:, None]
    r = np.einsum("ni,ni->n", planes.normals, se3.transform(T_old_new, points) - planes.points_m)
    limit = _AGREES_M + _AGREES_SIGMAS * np.hypot(old.k_per_m, new.k_per_m) * planes.points_m[:, 2] ** 2
    agrees = measured & there.good & (np.abs(r) < limit)
    return float(agrees.sum() / max(measured.sum(), 1)), int(agrees.sum())


def _refined(before: Before, after: Before, corner_px: FloatArray, corner_m: FloatArray, start: FloatArray) -> Motion:
    lens = before.camera.intrinsics
    with np.errstate(all="ignore"):
        expected = lens.project(se3.transform(se3.inverse(start), corner_m))
    inside = np.all((expected > 5) & (expected < lens.size_px - 6), axis=1)
    mine = np.flatnonzero(inside)
    found, tracked = pixels.track(before.grey, after.grey, corner_px[mine], expected[mine])
    kept = mine[found]
    return fit_motion(Tracks(corner_m[kept], tracked), lens, before.surface, after.surface, start)


def _apart(T: FloatArray, T_other: FloatArray) -> bool:
    """Clearly different motions: by more than a degree or 20 mm."""
    D = se3.inverse(T) @ T_other
    return bool(so3.angle_rad(D[:3, :3]) > np.radians(1.0) or np.linalg.norm(D[:3, 3]) > 0.02)

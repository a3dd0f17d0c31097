"""The motion of one camera between two snapshots of the same scene, by itself: against its own old images.

features -> consensus by pixels -> candidates, the camera at rest among them -> the one that most of the depth agrees with
-> tracked corners and patches of depth together -> covariance, free directions
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.trust.snapshot import pixels
from rgbd_calib.trust.snapshot.motion import Motion, Tracks, fit_motion, undrifted
from rgbd_calib.trust.snapshot.pixels import Features, Matches
from rgbd_calib.trust.snapshot.surfaces import Surface
from rgbd_calib.types import CameraSnapshot, RigCamera

_CONSENSUS_PX = 2.0
_APART_PX = 6.0
"""A consensus within 2 px may extrapolate three times as far; other motions are farther apart."""
_LEAST_MATCHES = 12
_CANDIDATES = 3
_AGREES_M, _AGREES_SIGMAS = 0.004, 4.0


class Before:
    """A camera's old snapshot, ready to be compared; monitors keep it."""

    def __init__(self, camera: RigCamera, snapshot: CameraSnapshot) -> None:
        self.camera = camera
        self.surface = Surface(camera, snapshot.depth_m)
        self.grey = pixels.grey(snapshot.color)
        self.features = Features.of(self.grey)

    @cached_property
    def lookup(self) -> ColorLookup:
        return ColorLookup(self.surface, self.camera.intrinsics)

    @cached_property
    def corners(self) -> tuple[FloatArray, FloatArray]:
        """Pixels (n, 2) worth tracking, and the points (n, 3) there, metres, in the colour camera's frame."""
        px = pixels.corners(self.grey)
        found, points_m = self.lookup.points(px)
        return px[found], points_m


@dataclass(frozen=True)
class CameraMotion:
    """What one camera did between two snapshots."""

    camera: str
    motion: Motion
    unchanged_share: float
    """Share of the patches seen in both that lie where they lay."""
    rival: float
    """Support of the best motion that is clearly another one, relative to this one's; 0 where there is none."""
    rows: int
    """Patches and tracks that the estimate rests on."""


def camera_motion(name: str, before: Before, snapshot: CameraSnapshot) -> CameraMotion:
    """The motion of a camera from its old to its new snapshot."""
    after = Before(before.camera, snapshot)
    lens = before.camera.intrinsics
    matches = pixels.match_features(before.features, after.features)
    found, points = before.lookup.points(matches.old_px)
    matches = matches.only(found)
    starts = [np.eye(4), *_consensus(points, matches, lens)]
    scored = [_Support.of(T, before.surface, after.surface, points, matches, lens) for T in starts]
    best = max(scored, key=lambda s: s.both)
    motion = _refined(before, after, best.T_old_new)
    motion = _refined(before, after, motion.T_old_new)
    mine = _Support.of(motion.T_old_new, before.surface, after.surface, points, matches, lens, motion.drift)
    rivals = [s.against(mine) for s in scored if _apart(s.T_old_new, motion.T_old_new, before.corners[1], lens)]
    return CameraMotion(
        name, motion, mine.patches, max(rivals, default=0.0), int(motion.patches.rows + motion.tracks.rows)
    )


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
        left = np.delete(left, np.asarray(inliers.ravel(), int))
    return out


@dataclass(frozen=True)
class _Support:
    """How much of what is seen agrees with a motion."""

    T_old_new: FloatArray
    patches: float
    """Share of the patches that both depth images measure."""
    matches: float
    """Share of the matched features on them."""

    @property
    def both(self) -> float:
        return self.patches + self.matches

    def against(self, other: _Support) -> float:
        """Relative to another's support: the smaller of the two ratios, since planes can slide and texture repeats."""
        by_pixels = self.matches / other.matches if other.matches > 0 else 1.0
        return min(self.patches / max(other.patches, 1e-9), by_pixels)

    @classmethod
    def of(
        cls,
        T: FloatArray,
        old: Surface,
        new: Surface,
        points_m: FloatArray,
        matches: Matches,
        lens: Intrinsics,
        drift: FloatArray | None = None,
    ) -> _Support:
        _, planes = old.planes
        at, inside = new.pixels_of(se3.transform(se3.inverse(T), planes.points_m))
        planes, at = planes.only(inside), at[inside]
        there = new.patches(at)
        measured = np.isfinite(new.points_m[at[:, 1], at[:, 0]]).all(axis=1)
        points = there.points_m if drift is None else undrifted(there.points_m, drift)
        r = np.einsum("ni,ni->n", planes.normals, se3.transform(T, points) - planes.points_m)
        limit = _AGREES_M + _AGREES_SIGMAS * np.hypot(old.k_per_m, new.k_per_m) * planes.points_m[:, 2] ** 2
        agrees = measured & there.good & (np.abs(r) < limit)
        with np.errstate(all="ignore"):
            px = lens.project(se3.transform(se3.inverse(T), points_m)) - matches.new_px
        close = np.linalg.norm(px, axis=1) < _CONSENSUS_PX
        return cls(T, float(agrees.sum() / max(measured.sum(), 1)), float(close.mean()) if len(close) else 0.0)


def _refined(before: Before, after: Before, start: FloatArray) -> Motion:
    lens, (corner_px, corner_m) = before.camera.intrinsics, before.corners
    with np.errstate(all="ignore"):
        expected = lens.project(se3.transform(se3.inverse(start), corner_m))
    inside = np.all((expected > 5) & (expected < lens.size_px - 6), axis=1)
    mine = np.flatnonzero(inside)
    found, tracked = pixels.track(before.grey, after.grey, corner_px[mine], expected[mine])
    kept = mine[found]
    tracks = Tracks(corner_m[kept], tracked, pixels.noise_px2(before.grey, after.grey, tracked))
    return fit_motion(tracks, lens, before.surface, after.surface, start)


def _apart(T: FloatArray, T_other: FloatArray, points_m: FloatArray, lens: Intrinsics) -> bool:
    """Do two motions put the points (n, 3) of the old image clearly elsewhere in the new one?"""
    if len(points_m) == 0:
        return False
    with np.errstate(all="ignore"):
        px = [lens.project(se3.transform(se3.inverse(each), points_m)) for each in (T, T_other)]
    return float(np.nanmedian(np.linalg.norm(px[0] - px[1], axis=1))) > _APART_PX

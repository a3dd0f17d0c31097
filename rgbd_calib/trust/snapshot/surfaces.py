"""Planes of small patches of a depth image: what two depth images of the same scene are compared by.

A patch is the square window of `WINDOW_PX` about a pixel. The mean m and the covariance S of its points come from box sums, so
that a patch at any pixel costs the same; the normal is the eigenvector of the smallest eigenvalue of S. A patch counts where
the window is nearly full, its points are within the noise of a plane, and the plane is not seen at a grazing angle.

The noise of normals seems to determine what it does not: with a plane alone, N rows of point to plane whose normals err by s_n
say of sliding what N s_n^2 true ones would. The deviation of a normal is that of a patch's mean over the patch's extent e, so that
sliding seems known to 2 e / sqrt(N), however small the noise: some mm. So the normal is that of the largest of the windows `SCALES`
in which the surface is flat, whose error is 9 and 81 times smaller.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import cv2
import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import RigCamera

WINDOW_PX = 9
"""About the matching window of structured light: smaller patches share their noise."""
STEP_PX = WINDOW_PX
SCALES = (1, 3, 9)
"""Of the window, for normals."""
_FULL = 0.8
"""Share of the window that must be measured."""
_GRAZING_COS = 0.25
"""75 degrees; the noise of depth grows beyond, and pixels mix."""
_FLAT_SIGMAS = 2.5
"""RMS about the plane allowed, in deviations of a single reading."""
_ROUNDING_M = 0.5e-3


@dataclass(frozen=True)
class Patches:
    """Planes at n pixels of a depth image, in the colour camera's frame."""

    points_m: FloatArray
    """(n, 3) means of the windows."""
    normals: FloatArray
    """(n, 3) towards the camera."""
    good: np.ndarray
    """(n,) bool: measured, flat, not at a grazing angle."""
    wide: np.ndarray
    """(n,) bool: the next window of `SCALES` is so too."""

    def only(self, which: np.ndarray) -> Patches:
        return Patches(self.points_m[which], self.normals[which], self.good[which], self.wide[which])

    def and_(self, other: Patches) -> Patches:
        """These and others."""
        both = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self))
        return Patches(*(np.concatenate(pair) for pair in both))


class Surface:
    """The surfaces that a depth image (h, w), metres as measured, shows, in the colour camera's frame, corrected by the rig."""

    def __init__(self, camera: RigCamera, depth_m: FloatArray) -> None:
        self._camera = camera.depth_sensor.camera
        self._T_depth_color = se3.inverse(self._camera.T_color_depth)
        self.points_m = camera.depth_image.points(depth_m)
        """(h, w, 3)."""
        seen = np.asarray(np.isfinite(self.points_m).all(axis=-1))
        # about a point in the middle of the scene: the sums of squares keep their digits
        self._about_m = self.points_m[seen].mean(axis=0) if seen.any() else np.zeros(3)
        p = [np.where(seen, self.points_m[..., k] - self._about_m[k], 0.0) for k in range(3)]
        self._sums = _box_sums([seen.astype(float), *p, *(p[i] * p[j] for i, j in _PAIRS)])
        # the patches that were asked for, and where each pixel's is among them
        self._known = Patches(np.empty((0, 3)), np.empty((0, 3)), np.empty(0, bool), np.empty(0, bool))
        self._index = np.full(self.shape, -1)

    @cached_property
    def k_per_m(self) -> float:
        """The deviation of a pixel is k z^2, z in metres: by the patches, most of which are planes."""
        planes, rms = self._fit(self.grid())
        z = planes.points_m[:, 2]
        k = rms[planes.good] / z[planes.good] ** 2
        return max(float(np.median(k)), _LEAST_K_PER_M) if len(k) else _USUAL_K_PER_M

    @property
    def shape(self) -> tuple[int, int]:
        return self.points_m.shape[0], self.points_m.shape[1]

    def grid(self) -> np.ndarray:
        """Pixels (n, 2), int, u and v, of the patches that fill the image."""
        h, w = self.shape
        u, v = np.meshgrid(np.arange(STEP_PX // 2, w, STEP_PX), np.arange(STEP_PX // 2, h, STEP_PX))
        return np.stack([u.ravel(), v.ravel()], axis=1)

    @cached_property
    def planes(self) -> tuple[np.ndarray, Patches]:
        """The good ones of the patches that fill the image, and their pixels (n, 2), int."""
        pixels = self.grid()
        patches = self.patches(pixels)
        return pixels[patches.good], patches.only(patches.good)

    def patches(self, pixels: np.ndarray) -> Patches:
        """The planes at pixels (n, 2), int, inside the image; what an earlier call has fitted is not fitted again."""
        u, v = pixels.T
        fresh = pixels[self._index[v, u] < 0]
        if len(fresh):
            self._index[fresh[:, 1], fresh[:, 0]] = len(self._known.points_m) + np.arange(len(fresh))
            self._known = self._known.and_(self._planes_at(fresh))
        return self._known.only(self._index[v, u])

    def _planes_at(self, pixels: np.ndarray) -> Patches:
        planes, rms = self._fit(pixels)
        noise = _FLAT_SIGMAS * (self.k_per_m * planes.points_m[:, 2] ** 2 + _ROUNDING_M)
        flat = planes.good & (rms < noise)
        normals, kept = planes.normals, [flat]
        for level in range(1, len(SCALES)):
            which = np.flatnonzero(flat)
            larger, rms = self._fit(pixels[which], level)
            which = which[still := larger.good & (rms < noise[which])]
            normals[which] = larger.normals[still]
            flat = np.zeros_like(flat)
            flat[which] = True
            kept.append(flat)
        return Patches(planes.points_m, normals, kept[0], kept[1])

    def _fit(self, pixels: np.ndarray, level: int = 0) -> tuple[Patches, FloatArray]:
        """The planes, flat or not, of the windows of one of the scales, and the RMS (n,) of their points about them, metres."""
        u, v = (pixels // _thin(SCALES[level])).T
        sums = self._sums[level][v, u]
        count = np.maximum(sums[:, 0], 1.0)
        mean = sums[:, 1:4] / count[:, None]
        S = np.empty((len(pixels), 3, 3))
        for k, (i, j) in enumerate(_PAIRS):
            S[:, i, j] = S[:, j, i] = sums[:, 4 + k] / count - mean[:, i] * mean[:, j]
        values, vectors = np.linalg.eigh(S)
        normals, points = vectors[..., 0], mean + self._about_m
        length = np.linalg.norm(points, axis=1)
        cos = -np.einsum("ij,ij->i", normals, points) / np.maximum(length, 1e-9)
        normals = normals * np.where(cos < 0, -1.0, 1.0)[:, None]
        rms = np.sqrt(np.maximum(values[:, 0], 0))
        good = (sums[:, 0] >= _FULL * (WINDOW_PX * SCALES[level]) ** 2) & (np.abs(cos) > _GRAZING_COS)
        return Patches(points, normals, good, good), rms

    def pixels_of(self, points_m: FloatArray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (n, 2), int, of the depth image where points (n, 3) in the colour camera's frame are seen, and which
        are inside (n,)."""
        h, w = self.shape
        p = se3.transform(self._T_depth_color, points_m)
        ahead = p[:, 2] > 0.05
        with np.errstate(all="ignore"):
            pixels = self._camera.intrinsics.project(np.where(ahead[:, None], p, [0.0, 0.0, 1.0]))
        inside = ahead & np.all((pixels > -0.5) & (pixels < np.array([w, h]) - 0.5), axis=1)
        return np.where(inside[:, None], np.rint(np.where(inside[:, None], pixels, 0)), 0).astype(int), inside


def _thin(scale: int) -> int:
    """Pixels from one window that is kept to the next: larger windows are looked up to the pixel no more, a sixteenth of
    the memory."""
    return 1 if scale == 1 else 4


def _box_sums(layers: list[FloatArray]) -> list[FloatArray]:
    """Sums (h, w, n) of n layers (h, w) over the window of each of `SCALES` about each pixel that is kept."""
    out: list[FloatArray] = []
    for scale in SCALES:
        side, thin = (WINDOW_PX * scale, WINDOW_PX * scale), _thin(scale)
        sums = [cv2.boxFilter(layer, -1, side, normalize=False)[::thin, ::thin] for layer in layers]
        out.append(np.stack(sums, axis=-1))
    return out


_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_USUAL_K_PER_M = 1.6e-3
"""Of structured light, one image (Khoshelham, Oude Elberink 2012): where there are no patches to tell by."""
_LEAST_K_PER_M = 1e-5

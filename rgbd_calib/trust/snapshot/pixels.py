"""Points of the old colour image found again in the new one.

First SIFT features, matched both ways with Lowe's ratio, for any motion. Then, with the motion known to a pixel or so, corners of
the old image are tracked by Lucas and Kanade's method from where the motion puts them, forth and back: ten times as precise, and
many more. Images are normalised to their local mean and contrast first, so that light may change.

References
----------
D. Lowe, Distinctive image features from scale-invariant keypoints, IJCV 60(2), 2004. J.-Y. Bouguet, Pyramidal
implementation of the Lucas Kanade feature tracker, Intel, 2000.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rgbd_calib.geometry.so3 import FloatArray

_RATIO = 0.8
_MOST_FEATURES = 2000
_CONTRAST = 0.015
"""Least contrast of a SIFT feature; OpenCV's 0.04 leaves dim rooms without any."""
_MOST_CORNERS, _APART_PX = 1500, 6
_CORNER_QUALITY = 0.005
_WINDOW_PX = 13
_LOCAL_PX = 12.0
"""Deviation of the Gaussian over which an image is normalised."""
_SMOOTH_PX = 0.8
"""Smoothing before tracking: interpolation between sharp pixels pulls tracks towards whole pixels."""
_NOISE_AREA_PX2 = 4 * np.pi * _SMOOTH_PX**2
"""Of which the noise is one value after smoothing."""
_NOISE_SLOPE2 = 0.5 * (1 - np.exp(-(_SMOOTH_PX**-2)))
"""Variance of central differences of such noise, over its own."""
_FLOOR_GREY = 4.0
"""Contrast below which noise is not blown up, steps of 255."""
_ALIKE = 0.85
"""Least correlation of a track's two windows: texture that is twice as strong as the noise."""
_BACK_PX = 0.3
"""A track that does not come back to within this is lost."""


@dataclass(frozen=True)
class Matches:
    """Pixels of the same points in the old and in the new image."""

    old_px: FloatArray
    """(n, 2)."""
    new_px: FloatArray
    """(n, 2)."""

    def only(self, which: np.ndarray) -> Matches:
        return Matches(self.old_px[which], self.new_px[which])

    def __len__(self) -> int:
        return len(self.old_px)


def grey(color: np.ndarray) -> np.ndarray:
    """(h, w), uint8, normalised to the local mean and contrast, of an image (h, w, 3), uint8, B G R."""
    image = cv2.cvtColor(color, cv2.COLOR_BGR2GRAY).astype(np.float32)
    mean = cv2.GaussianBlur(image, (0, 0), _LOCAL_PX)
    square = cv2.GaussianBlur(image**2, (0, 0), _LOCAL_PX)
    contrast = np.sqrt(np.maximum(square - mean**2, 0) + _FLOOR_GREY**2)
    normal = cv2.GaussianBlur((image - mean) / contrast, (0, 0), _SMOOTH_PX)
    return np.clip(128 + 45 * normal, 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class Features:
    """SIFT features of one image."""

    at_px: FloatArray
    """(n, 2)."""
    descriptors: np.ndarray
    """(n, 128), of length 1: the squared distance of two is 2 - 2 cos."""

    @classmethod
    def of(cls, image: np.ndarray) -> Features:
        """Those of an image (h, w), uint8."""
        keys, about = cv2.SIFT.create(nfeatures=_MOST_FEATURES, contrastThreshold=_CONTRAST).detectAndCompute(
            image, None
        )
        if about is None:
            return cls(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
        length = np.linalg.norm(about, axis=1, keepdims=True)
        return cls(np.array([key.pt for key in keys], float), about / np.maximum(length, 1e-9))


def match_features(old: Features, new: Features) -> Matches:
    """Features of two images that are each other's best match."""
    if min(len(old.at_px), len(new.at_px)) < 2:
        return Matches(np.zeros((0, 2)), np.zeros((0, 2)))
    cos = old.descriptors @ new.descriptors.T
    best = np.argmax(cos, axis=1)
    rows = np.arange(len(cos))
    first = cos[rows, best]
    cos[rows, best] = -1.0
    second = cos.max(axis=1)
    cos[rows, best] = first
    clear = (1 - first) < _RATIO**2 * (1 - second)
    mutual = np.argmax(cos, axis=0)[best] == rows
    kept = np.flatnonzero(clear & mutual)
    pairs = np.concatenate([old.at_px[kept], new.at_px[best[kept]]], axis=1)
    # a place with two directions is two features, and would count twice
    pairs = np.unique(np.round(pairs, 2), axis=0)
    return Matches(pairs[:, :2], pairs[:, 2:])


def corners(image: np.ndarray) -> FloatArray:
    """Corners (n, 2) of an image (h, w), uint8, worth tracking."""
    found = cv2.goodFeaturesToTrack(image, _MOST_CORNERS, _CORNER_QUALITY, _APART_PX, blockSize=5)
    return np.zeros((0, 2)) if found is None else np.asarray(found.reshape(-1, 2), float)


def track(old: np.ndarray, new: np.ndarray, old_px: FloatArray, expected_px: FloatArray) -> tuple[np.ndarray, Matches]:
    """Pixels (n, 2) of the old image in the new one, from where they are expected (n, 2): which were found (m,), and where."""
    if len(old_px) == 0:
        return np.zeros(0, int), Matches(np.zeros((0, 2)), np.zeros((0, 2)))
    start, guess = (np.ascontiguousarray(px[:, None], np.float32) for px in (old_px, expected_px))
    there = _flow(old, new, start, guess)
    back = _flow(new, old, there, start)
    away = np.linalg.norm((back - start)[:, 0], axis=1)
    h, w = new.shape
    inside = np.all((there[:, 0] > 2) & (there[:, 0] < np.array([w, h]) - 3), axis=1)
    alike = similarity(old, new, old_px, np.asarray(there[:, 0], float))
    kept = np.flatnonzero((away < _BACK_PX) & inside & (alike > _ALIKE))
    return kept, Matches(np.asarray(old_px[kept], float), np.asarray(there[kept, 0], float))


def _flow(a: np.ndarray, b: np.ndarray, a_px: np.ndarray, guess_px: np.ndarray) -> np.ndarray:
    """Pixels (n, 1, 2), float32, of image a in image b; those that are lost are far away."""
    found_px, found, _ = cv2.calcOpticalFlowPyrLK(
        a, b, a_px, guess_px.copy(),
        winSize=(_WINDOW_PX, _WINDOW_PX),
        maxLevel=1,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.005),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return np.where(found[..., None] == 1, found_px, np.float32(-1e4))


def similarity(old: np.ndarray, new: np.ndarray, old_px: FloatArray, new_px: FloatArray) -> FloatArray:
    """Normalised cross-correlation (n,) of the windows about pixels (n, 2) of two images.

    In noise a track stays where it was put, which looks like a camera at rest; noise does not repeat itself.
    """
    windows = [w - w.mean(axis=(1, 2), keepdims=True) for w in (_windows(old, old_px), _windows(new, new_px))]
    windows = [w / np.maximum(np.linalg.norm(w, axis=(1, 2), keepdims=True), 1e-9) for w in windows]
    return np.asarray(np.einsum("nij,nij->n", *windows))


def noise_px2(old: np.ndarray, new: np.ndarray, tracks: Matches) -> FloatArray:
    """Covariance (n, 2, 2) of tracks by the noise of the images alone, px^2, to a factor of two or so.

    The noise s^2 of the windows moves a track by s^2 G^-1, G the sum of the products of the gradients: along a lonely edge a
    track stays where it was put. How fine the texture is against the smoothed noise makes the factor.
    """
    a, b = _windows(old, tracks.old_px), _windows(new, tracks.new_px)
    down, across = np.gradient(a, axis=(1, 2))
    slope = np.stack([across, down], axis=1).reshape(len(a), 2, _WINDOW_PX**2)
    g, V = np.linalg.eigh(slope @ slope.transpose(0, 2, 1))
    noise2 = np.var(a - b, axis=(1, 2))[:, None] / 2
    g = np.maximum(g - _NOISE_SLOPE2 * _WINDOW_PX**2 * noise2, 0.0)
    most = float(_WINDOW_PX**2)
    variance = np.minimum(_NOISE_AREA_PX2 * noise2, most * g) / np.maximum(g, 1e-300)
    return np.asarray(V * np.where(g > 0, variance, most)[:, None] @ V.transpose(0, 2, 1))


def _windows(image: np.ndarray, at_px: FloatArray) -> FloatArray:
    """(n, 13, 13) about pixels (n, 2)."""
    if not len(at_px):
        return np.zeros((0, _WINDOW_PX, _WINDOW_PX))
    reach = np.arange(_WINDOW_PX) - _WINDOW_PX // 2
    x = np.asarray(at_px[:, 0, None] + np.tile(reach, _WINDOW_PX), np.float32)
    y = np.asarray(at_px[:, 1, None] + np.repeat(reach, _WINDOW_PX), np.float32)
    values = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values.astype(float).reshape(-1, _WINDOW_PX, _WINDOW_PX)

"""Saddle points of the brightness: candidates for corners of a checkerboard, and the directions of their edges.

At a corner of a checkerboard the gradient vanishes and the determinant of the Hessian is negative and large. The zero
directions of its quadratic form are those of the edges, and where the form is positive the squares are bright. Adjacent
corners have the same Hessian with opposite sign, for black and white are exchanged. Most saddle points of other objects fail
on a circle around them: around a corner, the brightness crosses the corner's own value four times, in two opposite pairs.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rgbd_calib.geometry.so3 import FloatArray

SMOOTHING_PX = 1.0
CIRCLE_PX = 3.0
MOST = 1500
"""Number of saddles that are kept, the strongest first. In 9 of 10 boards of scripts/benchmark_detection.py, all corners are
among the first 130; in deep shadow and noise among the first 800."""
MIN_STRENGTH = 1.0
"""Of a saddle, grey steps^2 / px^4: a corner whose squares differ by 6 grey steps, blurred by 1 px."""
MAX_STEP_PX = 1.5
"""The gradient vanishes no farther from the strongest pixel."""
_BORDER = 3
_ANGLES = np.linspace(0, 2 * np.pi, 16, endpoint=False)
_CIRCLE = np.append(CIRCLE_PX * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)]), np.zeros((2, 1)), axis=1)
"""The circle and its middle (2, 17)."""
_OPPOSITE = np.deg2rad(25)
"""The two crossings of one edge are opposite within this much."""
_SECOND = np.array([[1, 0, -2, 0, 1]], np.float32) / 4
_MIXED = np.array([[1, 0, -1], [0, 0, 0], [-1, 0, 1]], np.float32) / 4


@dataclass(frozen=True)
class Saddles:
    """Saddles of an image, the strongest first."""

    smooth: np.ndarray
    """(h, w) float32: the image's brightness, smoothed."""
    px: FloatArray
    """(n, 2)."""
    hessian: FloatArray
    """(n, 3): (I_xx, sqrt(2) I_xy, I_yy) over their norm."""
    log_strength: FloatArray
    """(n,): logarithm of -det of the Hessian, grey steps^2 / px^4."""
    edges: FloatArray
    """(n, 4, 2): unit vectors u, v, -u, -v along the edges, in the order of their angles; the square between u and v is
    bright."""
    clear: np.ndarray
    """(n,) bool: two straight edges cross the circle around it."""


def find_saddles(gray: np.ndarray, most: int = MOST) -> Saddles:
    """The `most` strongest saddles of a grey image (h, w) uint8."""
    f = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), SMOOTHING_PX)
    xx, yy, xy = (cv2.filter2D(f, -1, kernel) for kernel in (_SECOND, _SECOND.T, _MIXED))
    y, x = _peaks(xx, yy, xy)
    a, b, c = (second[y, x].astype(float) for second in (xx, xy, yy))
    gx, gy = (f[y, x + 1].astype(float) - f[y, x - 1]) / 2, (f[y + 1, x].astype(float) - f[y - 1, x]) / 2
    det = a * c - b * b
    step = np.stack([b * gy - c * gx, b * gx - a * gy], axis=1) / det[:, None]  # to where the gradient vanishes
    near = np.flatnonzero(np.einsum("ij,ij->i", step, step) < MAX_STEP_PX**2)[:most]
    px = np.stack([x, y], axis=1)[near] + step[near]
    a, b, c = a[near], b[near], c[near]
    hessian = np.stack([a, np.sqrt(2) * b, c], axis=1)
    hessian /= np.linalg.norm(hessian, axis=1, keepdims=True)
    return Saddles(f, px, hessian, np.log(-det[near]), *_edges_on_circle(f, px))


def _peaks(xx: np.ndarray, yy: np.ndarray, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the local maxima of -det, the strongest first."""
    strength = xy * xy
    strength -= xx * yy
    peak = strength == cv2.dilate(strength, np.ones((5, 5), np.uint8))
    peak &= strength > MIN_STRENGTH
    peak[:_BORDER] = peak[-_BORDER:] = peak[:, :_BORDER] = peak[:, -_BORDER:] = False
    at = np.flatnonzero(peak)
    at = at[np.argsort(-strength.ravel()[at], kind="stable")]
    y, x = np.divmod(at, strength.shape[1])
    return y, x


def _edges_on_circle(f: np.ndarray, px: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """u, v, -u, -v (n, 4, 2) by the circles around the points, and where two straight edges cross them (n,)."""
    edges, clear = np.zeros((len(px), 4, 2)), np.zeros(len(px), bool)
    if not len(px):
        return edges, clear
    u, v = (px.T[..., None] + _CIRCLE[:, None]).astype(np.float32)
    value = cv2.remap(f, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    above = value[:, :-1] - value[:, -1:]
    bright = above > 0
    change = bright != np.roll(bright, -1, axis=1)
    clear = change.sum(axis=1) == 4
    i, k = np.nonzero(change & clear[:, None])
    before, after = above[i, k], above[i, (k + 1) % len(_ANGLES)]
    at = ((k + before / (before - after)) * (2 * np.pi / len(_ANGLES))).reshape(-1, 4)
    turn = (at[:, 2:] - at[:, :2]) - np.pi
    straight = (np.abs(turn) < _OPPOSITE).all(axis=1)
    mean = (at[:, :2] + at[:, 2:] - np.pi) / 2
    dark_between = ~bright[i.reshape(-1, 4)[:, 0], (k.reshape(-1, 4)[:, 0] + 1) % len(_ANGLES)]
    first = np.where(dark_between, mean[:, 1], mean[:, 0])
    second = np.where(dark_between, mean[:, 0] + np.pi, mean[:, 1])
    axes = np.stack([np.cos(first), np.sin(first), np.cos(second), np.sin(second)], axis=1).reshape(-1, 2, 2)
    clear[clear] = straight
    edges[clear] = np.concatenate([axes, -axes], axis=1)[straight]
    return edges, clear

"""A quick look for corners of a checkerboard: is it worth searching, and where?

At a corner of a checkerboard the brightness has a saddle: the determinant of its Hessian is negative and large. On a
circle around it the brightness crosses the corner's own value four times, in two opposite pairs; and the corners beside
it have the same Hessian with the sign turned, for there black and white change places. Things other than boards have
saddles too, but hardly any with two such neighbours.
"""

from __future__ import annotations

import cv2
import numpy as np

from rgbd_calib.geometry.so3 import FloatArray

SMOOTHING_PX = 1.0
CIRCLE_PX = 3.0
_ANGLES = np.linspace(0, 2 * np.pi, 32, endpoint=False)
_OPPOSITE = np.deg2rad(25)
"""The two crossings of one edge are opposite within this much."""
_NEIGHBOURS = 8
_TURNED = -0.8
"""Cosine between the Hessians of neighbours, at most; on simulated boards below -0.87."""
_ALIKE = np.log(3.0)
"""Neighbours' determinants differ by less than this factor; on simulated boards 2.1 over a whole board."""
_SECOND = np.array([[1, 0, -2, 0, 1]], np.float32) / 4
_MIXED = np.array([[1, 0, -1], [0, 0, 0], [-1, 0, 1]], np.float32) / 4


def board_corners(gray: np.ndarray, most: int) -> FloatArray:
    """Saddles (n, 2), px, that look like corners of a checkerboard and have neighbours that do; of the `most` strongest."""
    f = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), SMOOTHING_PX)
    xx, yy, xy = (cv2.filter2D(f, -1, kernel) for kernel in (_SECOND, _SECOND.T, _MIXED))
    strength = xy * xy - xx * yy
    peak = (strength == cv2.dilate(strength, np.ones((5, 5), np.uint8))) & (strength > 1)
    y, x = np.nonzero(peak)
    if len(x) == 0:
        return np.empty((0, 2))
    first = np.argsort(-strength[y, x], kind="stable")[:most]
    y, x = y[first], x[first]
    crossed = _crossed_twice(f, x, y)
    y, x = y[crossed], x[crossed]
    hessian = np.stack([xx[y, x], np.sqrt(2) * xy[y, x], yy[y, x]], axis=1)
    partnered = _has_neighbours(x, y, hessian, np.log(strength[y, x]))
    return np.column_stack([x, y])[partnered].astype(float)


def _crossed_twice(f: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(n,) bool: do two straight edges cross the circles around (x, y)?"""
    around_x = x[:, None] + CIRCLE_PX * np.cos(_ANGLES)
    around_y = y[:, None] + CIRCLE_PX * np.sin(_ANGLES)
    value = cv2.remap(
        f, around_x.astype(np.float32), around_y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    bright = value > f[y, x][:, None]
    change = bright != np.roll(bright, -1, axis=1)
    four = change.sum(axis=1) == 4
    at = _ANGLES[np.nonzero(change & four[:, None])[1]].reshape(-1, 4)
    turn = (at[:, 2:] - at[:, :2]) - np.pi
    four[four] = (np.abs(turn) < _OPPOSITE).all(axis=1)
    return np.asarray(four)


def _has_neighbours(x: np.ndarray, y: np.ndarray, hessian: np.ndarray, log_strength: np.ndarray) -> np.ndarray:
    """(n,) bool: are two of the nearest saddles like this one with black and white exchanged?"""
    n = len(x)
    if n < 3:
        return np.zeros(n, bool)
    apart = np.hypot(np.subtract.outer(x, x), np.subtract.outer(y, y)).astype(float)
    np.fill_diagonal(apart, np.inf)
    near = np.argsort(apart, axis=1, kind="stable")[:, : min(_NEIGHBOURS, n - 1)]
    unit = hessian / np.linalg.norm(hessian, axis=1, keepdims=True)
    turned = np.einsum("ik,ijk->ij", unit, unit[near]) < _TURNED
    alike = np.abs(log_strength[:, None] - log_strength[near]) < _ALIKE
    return np.asarray((turned & alike).sum(axis=1) >= 2)

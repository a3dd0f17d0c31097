"""Red and blue against green: where each plane of a colour image has the board's corners.

The saddle point of each corner is found in the three planes apart. A shift that all corners share comes of planes that are
read or resampled apart from each other; one that grows with the distance from the image's middle is the lens's lateral
chromatic aberration. The grey image, in which corners are found, has a mixture of the three.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, BoardView
from rgbd_calib.views.doctor.measures import square_px

MIN_CORNERS = 40
"""A corner of one plane is good to some 0.1 px: their median is good to 0.02 px then."""
MIN_CONTRAST = 20
"""Grey levels: a plane in which the print has less tells nothing of where its corners are."""
APART_PX = 0.4
"""Shifts from here on are told: the grey image lies 0.3 (red) or 0.1 (blue) of them beside green, which is then more than
what a corner finder errs by. Lenses of RGB-D cameras have less than 0.3 px in the image's corner."""


@dataclass(frozen=True)
class PlaneShift:
    """Of one plane against green, px."""

    plane: str
    shift_px: FloatArray
    """(2,), of all corners."""
    at_corner_px: float
    """Radial part in the image's corner, outwards."""

    @property
    def apart(self) -> bool:
        return max(float(np.linalg.norm(self.shift_px)), abs(self.at_corner_px)) > APART_PX

    def __str__(self) -> str:
        dx, dy = self.shift_px
        parts = []
        if np.linalg.norm(self.shift_px) > APART_PX:
            parts.append(f"{self.plane} is {dx:+.2f}, {dy:+.2f} px beside green")
        if abs(self.at_corner_px) > APART_PX:
            way = "outwards" if self.at_corner_px > 0 else "inwards"
            parts.append(f"{self.plane} is {abs(self.at_corner_px):.2f} px {way} of green in the image's corners")
        return " and ".join(parts)


def corners_apart(image: np.ndarray, view: BoardView, board: Board) -> FloatArray:
    """Corners of red and of blue less those of green (n, 2, 2), px, in an image (h, w, 3) BGR; NaN where they cannot be told."""
    out = np.full((len(view.ids), 2, 2), np.nan)
    window = int(np.clip(0.3 * square_px(view, board), 2, 8))
    found = []
    start = view.corners_px.astype(np.float32).reshape(-1, 1, 2)
    for plane in (image[..., 1], image[..., 2], image[..., 0]):
        if np.ptp(cv2.blur(plane, (3, 3))[_box(view)]) < MIN_CONTRAST:
            return out
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
        found.append(cv2.cornerSubPix(np.ascontiguousarray(plane), start.copy(), (window, window), (-1, -1), criteria))
    green, *others = (f.reshape(-1, 2).astype(float) for f in found)
    for k, other in enumerate(others):
        near = np.linalg.norm(other - view.corners_px, axis=1) < window
        near &= np.linalg.norm(green - view.corners_px, axis=1) < window
        out[near, k] = (other - green)[near]
    return out


def plane_shifts(corners_px: FloatArray, apart_px: FloatArray, size: tuple[int, int]) -> tuple[PlaneShift, ...]:
    """What the corners (n, 2) of a camera's images of `size` and their differences (n, 2, 2) say; nothing of too few."""
    half = np.array(size) / 2
    from_middle = (corners_px - half + 0.5) / np.linalg.norm(half)
    out = []
    for k, name in enumerate(("red", "blue")):
        good = np.isfinite(apart_px[:, k]).all(axis=1)
        if good.sum() < MIN_CORNERS:
            continue
        d, r = apart_px[good, k], from_middle[good]
        rows = np.concatenate([np.column_stack([r[:, i], np.eye(2)[np.full(len(r), i)]]) for i in range(2)])
        values = d.T.ravel()
        weight = np.ones(len(values))
        for _ in range(20):  # least absolute deviations: corners beside a reflection do not count
            x = np.linalg.lstsq(rows * weight[:, None], values * weight, rcond=None)[0]
            weight = 1 / np.sqrt(np.maximum(np.abs(values - rows @ x), 0.02))
        out.append(PlaneShift(name, np.asarray(x[1:], float), float(x[0])))
    return tuple(out)


def sentence(camera: str, shifts: Sequence[PlaneShift]) -> str:
    """What is seen of a camera; empty where nothing is."""
    told = [str(s) for s in shifts if s.apart]
    return f"{camera}: colour planes are apart: {'; '.join(told)}" if told else ""


def _box(view: BoardView) -> tuple[slice, slice]:
    low, high = view.corners_px.min(axis=0).astype(int), view.corners_px.max(axis=0).astype(int) + 1
    return slice(max(low[1], 0), high[1]), slice(max(low[0], 0), high[0])

"""Rendering of a bent, distorted print with a ray caster of flat rectangles: where a ray meets the true face, and the page
coordinates there.

The ray caster contains the nominal plate. A ray from the eye e through the point q of a flat face continues to

    e + stretch (q - e) = sheet.points_m(page)

Both unknowns are smooth over the face. They are solved on a grid, once per image, and interpolated linearly.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.board import first_m, outline_m
from rgbd_calib.simulation.printed import Printed, PrintedFace

_NODE_M = 0.008
"""Grid spacing: offsets with a period of 0.2 m are linear in between to 1 % of their amplitude."""
_ROW = 1024
_EDGE_ON_M = 0.05
"""An eye nearer than this to the plane of a face does not see its print."""
_ROUNDS = 6
"""Fixed-point iterations; each reduces the error to 1 %, the slope of bow and offsets."""


@dataclass(frozen=True)
class BentFace:
    """One face as seen from one eye; (s, t) are metres along the edges of the flat face's rectangle."""

    nodes: np.ndarray
    """(b, a, 3), float32: increments of s, t and stretch (from 1) at grid nodes along t and s."""
    step_m: FloatArray
    """(2,), along s and t."""

    def meet(self, s_m: FloatArray, t_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Page coordinates (s, t) and stretch of rays through points (...) of the flat face."""
        n = s_m.size
        if not n:
            return s_m, t_m, np.ones_like(s_m)
        # cv2.remap takes at most 32767 rows; it rounds positions to 1/32 of a cell, which is 3 um on the page
        maps = np.zeros((2, -(-n // _ROW), _ROW), np.float32)
        for own, place, step in zip(maps, (s_m, t_m), self.step_m, strict=True):
            own.reshape(-1)[:n] = place.reshape(-1) / step
        add = cv2.remap(self.nodes, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        ds, dt, stretch = add.reshape(-1, 3)[:n].T.reshape(3, *s_m.shape)
        return s_m + ds, t_m + dt, 1.0 + stretch.astype(float)


def bent_faces(print_: Printed | None, T_room_board: FloatArray, eye_m: FloatArray) -> dict[int, BentFace]:
    """Visible faces by the number of their rectangle in :func:`board.plate`, for an eye (3,) in the room; none for an ideal board
    (None).
    """
    if print_ is None:
        return {}
    e = se3.transform(se3.inverse(T_room_board), eye_m)
    faces = {}
    if e[2] < -_EDGE_ON_M:
        faces[0] = _bent_face(print_.front, e)
    if print_.back is not None and e[2] > print_.back.board.thickness_m + _EDGE_ON_M:
        faces[1] = _bent_face(print_.back, e)
    return faces


def _bent_face(sheet: PrintedFace, eye_m: FloatArray) -> BentFace:
    low, high = outline_m(sheet.board)
    size = (high - low)[:2]
    n = np.ceil(size / _NODE_M).astype(int) + 1
    s, t = np.meshgrid(np.linspace(0, size[0], n[0]), np.linspace(0, size[1], n[1]))
    z = high[2] if sheet.back else low[2]
    q = np.stack([high[0] - s if sheet.back else low[0] + s, low[1] + t, np.full_like(s, z)], axis=-1)
    # the page's origin is corner (0, 0), the rectangle's the edge of the border
    page = flat = np.stack([s, t], axis=-1) - first_m(sheet.board)
    stretch = np.ones_like(s)
    for _ in range(_ROUNDS):
        p = sheet.points_m(page)
        stretch = (p[..., 2] - eye_m[2]) / (z - eye_m[2])
        ray = eye_m + stretch[..., None] * (q - eye_m)
        page = page + (ray - p)[..., :2] * ([-1, 1] if sheet.back else 1)
    nodes = np.concatenate([page - flat, (stretch - 1)[..., None]], axis=-1)
    return BentFace(nodes.astype(np.float32), size / (n - 1))

"""Is the board held still, and is it a new pose? From corners alone, look by look."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import IntArray

Corners = tuple[IntArray, FloatArray]
"""Numbers (n,) and pixels (n, 2) of one view."""


@dataclass(frozen=True)
class StillParams:
    still_px: float = 1.0
    """RMS by which the corners may move from look to look; a corner is found to about 0.1 px."""
    still_s: float = 0.5
    min_looks: int = 3
    moved_px: float = 12.0
    """RMS by which the corners must have moved since the last shot."""


class StillBoard:
    """Says when to take a shot: the board is seen, was still for a while, and has moved since the last one."""

    def __init__(self, params: StillParams | None = None) -> None:
        self._params = params or StillParams()
        self._looks: list[tuple[float, Mapping[str, Corners]]] = []
        self._taken: Mapping[str, Corners] = {}

    def look(self, time_s: float, corners: Mapping[str, Corners]) -> bool:
        """True where a shot is due now. `corners`: those cameras that see the board at `time_s`."""
        if not self._still_since_last(corners):
            self._looks = []
        if not corners:
            return False
        self._looks.append((time_s, corners))
        return self.is_still and self._new_pose()

    @property
    def is_still(self) -> bool:
        """The board has been still for long enough."""
        long_enough = bool(self._looks) and self._looks[-1][0] - self._looks[0][0] >= self._params.still_s
        return long_enough and len(self._looks) >= self._params.min_looks

    @property
    def waits_for_new_pose(self) -> bool:
        """Still, but where the last shot was taken already."""
        return self.is_still and not self._new_pose()

    def taken(self) -> None:
        """The shot was taken: the next one needs another pose."""
        self._taken = self._looks[-1][1] if self._looks else {}

    def _still_since_last(self, corners: Mapping[str, Corners]) -> bool:
        if not self._looks:
            return True
        moved_px = _moved_px(self._looks[-1][1], corners)
        return bool(moved_px) and max(moved_px.values()) <= self._params.still_px

    def _new_pose(self) -> bool:
        steady = set.intersection(*(set(corners) for _, corners in self._looks))
        now = self._looks[-1][1]
        moved_px = _moved_px(self._taken, now)
        return any(camera not in moved_px or moved_px[camera] >= self._params.moved_px for camera in steady)


def _moved_px(before: Mapping[str, Corners], now: Mapping[str, Corners]) -> dict[str, float]:
    """RMS motion of the corners in each camera that saw the board both times; a half turn of the order is no motion."""
    moved = {}
    for camera in before.keys() & now.keys():
        (ids_a, a), (ids_b, b) = before[camera], now[camera]
        _, in_a, in_b = np.intersect1d(ids_a, ids_b, return_indices=True)
        if len(in_a) == 0:
            continue
        a, b = a[in_a], b[in_b]
        rms = [float(np.sqrt(((a - other) ** 2).sum(axis=1).mean())) for other in (b, b[::-1])]
        moved[camera] = min(rms)
    return moved

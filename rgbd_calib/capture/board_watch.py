"""Looks for the board in every camera, again and again, without getting into the readers' way."""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass

import cv2
import numpy as np

from rgbd_calib.capture.stillness import Corners
from rgbd_calib.sensors.frames import FrameSet
from rgbd_calib.types import Board, BoardView
from rgbd_calib.views.detect import DetectParams, find_corners

_NICENESS = 10
_THREADS = 2


@dataclass(frozen=True)
class DetectedFrameSet:
    """A frame set and where the board is in it."""

    frame_set: FrameSet
    corners: dict[str, Corners]
    """Of the cameras that see the board."""


class BoardFinder:
    """Finds corners in several pictures at once, in threads that yield to all others; use as a context manager."""

    def __init__(self, board: Board) -> None:
        self.board = board
        self._pool = ThreadPoolExecutor(_THREADS, "detector", initializer=_be_nice)
        self._params = DetectParams(escalate=False)

    def find(self, pictures: Mapping[str, np.ndarray]) -> dict[str, Corners]:
        """Corners in pictures (h, w, 3), R G B, by camera."""
        jobs = {camera: self._pool.submit(self._find, rgb) for camera, rgb in pictures.items()}
        found = {camera: job.result() for camera, job in jobs.items()}
        return {camera: corners for camera, corners in found.items() if corners is not None}

    def look(self, frame_set: FrameSet) -> DetectedFrameSet:
        return DetectedFrameSet(frame_set, self.find({c: f.color.pixels for c, f in frame_set.frames.items()}))

    def __enter__(self) -> BoardFinder:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _find(self, rgb: np.ndarray) -> Corners | None:
        return find_corners(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), self.board, self._params)


def board_views(frame: str, corners: Mapping[str, Corners]) -> list[BoardView]:
    """The corners as views of frame set `frame`; coverage needs no depth."""
    return [
        BoardView(camera, frame, ids, px, np.full(len(ids), np.nan), np.zeros(len(ids), int))
        for camera, (ids, px) in corners.items()
    ]


def _be_nice() -> None:
    """Lower the priority of this thread alone, where the system has such a thing (Linux)."""
    with suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)

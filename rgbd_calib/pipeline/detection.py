"""All images of a recording through the detector, in threads (OpenCV works outside Python's lock)."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.io.correspondences import read_corners
from rgbd_calib.io.recording import Recording
from rgbd_calib.stages.detect import DetectParams, detect_view
from rgbd_calib.types import Board, BoardView

Progress = Callable[[Iterable[Any], int, str], Iterator[Any]]
"""Items, how many, and what is being done: yields the items and shows how far it is."""


def silent(items: Iterable[Any], total: int, what: str) -> Iterator[Any]:
    """No progress to be seen."""
    yield from items


@dataclass(frozen=True)
class Detections:
    """Views of the board, and the images in which it was not found."""

    views: tuple[BoardView, ...]
    missed: tuple[tuple[str, str], ...]
    """(camera, frame)."""

    def of(self, camera: str) -> tuple[BoardView, ...]:
        return tuple(view for view in self.views if view.camera == camera)


def board_of(recording: Recording) -> Board:
    """The board of dataset.yaml.

    Raises
    ------
    ConfigError
        There is none.
    """
    if recording.board is None:
        raise ConfigError(
            f"{recording.path / 'dataset.yaml'}: board is missing; the board that was filmed is needed, as "
            "board: {type: checkerboard, cols: 9, rows: 6, square: 0.060}. Measure it and add it"
        )
    return recording.board


def detect(
    recording: Recording, params: DetectParams, jobs: int | None = None, progress: Progress = silent
) -> Detections:
    """Find the board in every image of a recording; the result does not depend on `jobs`.

    Raises
    ------
    ConfigError
        A damaged image, or one of a wrong size or kind.
    CalibrationError
        The board is in no image at all.
    """
    board = board_of(recording)
    images = [(camera, frame) for camera, files in recording.color_files.items() for frame in files]

    def work(image: tuple[str, str]) -> BoardView | None:
        camera, frame = image
        depth_m = recording.depth_m(camera, frame) if recording.has_depth(camera, frame) else None
        return detect_view(camera, frame, recording.color(camera, frame), depth_m, board, params)

    threads_before = cv2.getNumThreads()
    cv2.setNumThreads(1)  # one image a thread is faster than several threads an image
    pool = ThreadPoolExecutor(jobs or os.cpu_count())
    try:
        found = list(progress(pool.map(work, images), len(images), "Finding the board"))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        cv2.setNumThreads(threads_before)
    views = tuple(view for view in found if view is not None)
    if not views:
        raise CalibrationError(
            f"{recording.path}: the board ({board.cols} x {board.rows} inner corners) was found in none of {len(images)} "
            "images. Check cols and rows in dataset.yaml (they count inner corners), the light and the focus"
        )
    return Detections(views, tuple(image for image, view in zip(images, found, strict=True) if view is None))


def detections_from(
    recording: Recording, corners: Path | None, params: DetectParams, jobs: int | None, progress: Progress
) -> Detections:
    """Detections read from corners.csv, or made now.

    Raises
    ------
    ConfigError
        corners.csv has a camera or corner that the recording has not.
    """
    if corners is None:
        return detect(recording, params, jobs, progress)
    views, board = read_corners(corners), board_of(recording)
    if not views:
        raise ConfigError(f"{corners}: no corners in it. Detect again with `rgbd-calib detect {recording.path}`")
    for view in views:
        if view.frame not in recording.color_files.get(view.camera, {}):
            raise ConfigError(
                f"{corners}: camera {view.camera}, frame {view.frame} is not in {recording.path}. Detect again with "
                f"`rgbd-calib detect {recording.path}`"
            )
        if view.ids.min() < 0 or view.ids.max() >= board.n_corners or len(set(view.ids.tolist())) < len(view.ids):
            raise ConfigError(
                f"{corners}: camera {view.camera}, frame {view.frame}: features 0 to {board.n_corners - 1}, each once, are "
                f"needed for a board of {board.cols} x {board.rows} inner corners. Detect again with this board"
            )
    found = {(view.camera, view.frame) for view in views}
    images = [(camera, frame) for camera, files in recording.color_files.items() for frame in files]
    return Detections(views, tuple(image for image in images if image not in found))

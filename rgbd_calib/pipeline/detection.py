"""All images of a recording through the detector; what was found before is taken from the cache."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.io.correspondences import read_corners
from rgbd_calib.io.recording import Recording
from rgbd_calib.pipeline.detection_cache import Contents, DetectionCache, contents, detector
from rgbd_calib.pipeline.workers import Ready, Workers
from rgbd_calib.types import Board, BoardView
from rgbd_calib.views.board_guess import guess_board
from rgbd_calib.views.detect import DetectParams, find_corners, with_depth

IMAGES_FOR_GUESS = 12
RARE = 0.25
"""Share of the images with the board below which another size is looked for: finders take a part of a board for the whole."""
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


@dataclass(frozen=True)
class ImageTask:
    """An image to look at, in any process that sees its files."""

    recording: Recording
    """Of this image alone."""
    camera: str
    frame: str
    board: Board
    params: DetectParams
    hashed: bool
    """The files' hashes are wanted too."""

    def __str__(self) -> str:
        return f"{self.recording.path}: camera {self.camera}, frame {self.frame}"


@dataclass(frozen=True)
class ImageDetection:
    """What was seen in an image, of which contents, by which detector; the last two are None for what was known."""

    view: BoardView | None
    contents: Contents | None = None
    detector: str | None = None


def find_in_image(task: ImageTask) -> ImageDetection:
    """Read an image and find the board; where it is found, read its depth.

    Raises
    ------
    ConfigError
        A damaged image, one of a wrong size or kind, or none that this process can see.
    """
    recording, at = task.recording, (task.camera, task.frame)
    check_seen(recording, *at)
    found = find_corners(cv2.cvtColor(recording.color(*at), cv2.COLOR_BGR2GRAY), task.board, task.params)
    view = None
    if found is not None:
        depth_m = recording.depth_m(*at) if recording.has_depth(*at) else None
        view = with_depth(*at, found, depth_m, task.board)
    return ImageDetection(view, contents(recording, *at) if task.hashed else None, detector())


def detect(
    recording: Recording, params: DetectParams, workers: Workers | None = None, progress: Progress = silent
) -> Detections:
    """Find the board in every image of a recording; the result does not depend on `workers`.

    Raises
    ------
    ConfigError
        A damaged image, or one of a wrong size or kind.
    CalibrationError
        The board is in no image at all.
    """
    workers = workers or Workers()
    board = board_of(recording)
    images = [(camera, frame) for camera, files in recording.color_files.items() for frame in files]
    sent = recording if workers.dask is None else replace(recording, path=recording.path.absolute())
    with closing(DetectionCache(recording, board, params, workers)) as cache:

        def work() -> Iterator[ImageTask | Ready[ImageDetection]]:
            for camera, frame in images:
                known = cache.look(camera, frame)
                if known is not None:
                    yield Ready(ImageDetection(known[0]))
                else:
                    yield ImageTask(sent.only(camera, frame), camera, frame, board, params, workers.cache is not None)

        found: list[BoardView | None] = []
        for image, result in zip(
            images,
            progress(workers.in_order(find_in_image, work()), len(images), "Finding the board"),
            strict=True,
        ):
            check_detector(result.detector, workers)
            cache.keep(*image, result.view, result.contents, result.detector)
            found.append(result.view)
    views = tuple(view for view in found if view is not None)
    if not views:
        raise CalibrationError(
            f"{recording.path}: the board ({board.cols} x {board.rows} inner corners) was found in none of {len(images)} "
            f"images{_instead(recording, images)}. Check cols and rows in dataset.yaml (they count inner corners), the light and the "
            "focus"
        )
    if len(views) < RARE * len(images) and (instead := _instead(recording, images)):
        raise CalibrationError(
            f"{recording.path}: the board ({board.cols} x {board.rows} inner corners) was found in {len(views)} of {len(images)} "
            f"images{instead}. Correct cols and rows in dataset.yaml: they count inner corners"
        )
    return Detections(views, tuple(image for image, view in zip(images, found, strict=True) if view is None))


def _instead(recording: Recording, images: list[tuple[str, str]]) -> str:
    """Which other checkerboard some of the images show, as a part of a sentence; empty where none."""
    some = images[:: -(-len(images) // IMAGES_FOR_GUESS)]
    guess = guess_board(recording.color(*image) for image in some)
    board = board_of(recording)
    stated = max(board.cols, board.rows), min(board.cols, board.rows)
    if guess is None or (guess.cols, guess.rows) == stated:
        return ""
    return f", one of {guess.cols} x {guess.rows} in {guess.images} of {guess.looked_at} that were tried"


def check_seen(recording: Recording, camera: str, frame: str) -> None:
    """Raise ConfigError where an image that the recording lists is not there for this process."""
    path = recording.color_files[camera][frame]
    if not path.exists():
        raise ConfigError(
            f"{path}: not seen on {socket.gethostname()}; every worker needs the recording under the same path. Put it on a "
            "file system that they share"
        )


def check_detector(seen: str | None, workers: Workers) -> None:
    """The same result wherever it was made: raise ConfigError where a cluster has other versions than this process."""
    if workers.dask is not None and seen not in (None, detector()):
        raise ConfigError(
            f"--dask {workers.dask}: a worker has other versions of rgbd-calib or of its libraries ({seen}) than this "
            f"computer ({detector()}); the same are needed for the same result. Install the same on both"
        )


def detections_from(
    recording: Recording, corners: Path | None, params: DetectParams, workers: Workers | None, progress: Progress
) -> Detections:
    """Detections read from corners.csv, or made now.

    Raises
    ------
    ConfigError
        corners.csv has a camera or corner that the recording has not.
    """
    if corners is None:
        return detect(recording, params, workers, progress)
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

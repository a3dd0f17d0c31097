"""AprilGrids as Kalibr prints them (kalibr_create_target_pdf): tags of 10 x 10 cells, tag 0 at the bottom left."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.types import Board

BORDER = 2
"""Cells of black around a tag's code."""


def check(board: Board) -> None:
    """Raise ConfigError unless the board has whole tags, has tags enough, and they leave a gap."""
    import cv2

    if board.cols % 2 or board.rows % 2:
        raise ConfigError(
            f"--cols {board.cols} --rows {board.rows}: an AprilGrid has two corners for each tag along columns and rows; even "
            f"numbers needed, such as {board.cols + board.cols % 2} and {board.rows + board.rows % 2}"
        )
    number = getattr(cv2.aruco, board.dictionary, None) if board.dictionary.startswith("DICT_APRILTAG_") else None
    if number is None:
        known = [name for name in dir(cv2.aruco) if name.startswith("DICT_APRILTAG_")]
        raise ConfigError(f"dictionary: '{board.dictionary}' seen, one of {', '.join(known)} needed")
    has = len(cv2.aruco.getPredefinedDictionary(number).bytesList)
    if board.n_corners > 4 * has:
        raise ConfigError(f"dictionary: {board.dictionary} has {has} tags, {board.n_corners // 4} are needed")
    if not board.square_m < board.marker_m < 2 * board.square_m:
        raise ConfigError(
            f"--marker {board.marker_m:g}: a tag's side between {board.square_m:g} and {2 * board.square_m:g} m (once and twice "
            "--square, which is half of what tags are apart) needed. Kalibr's usual spacing of 0.3 has tags of 1.54 squares"
        )


def gap_m(board: Board) -> float:
    """Between two tags, and the side of the small squares."""
    return 2 * board.square_m - board.marker_m


def tags(board: Board) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Top left corner (2,), metres from corner (0, 0), and cells (n, n), True = white, of each tag."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    side = dictionary.markerSize + 2 * BORDER
    cols = board.cols // 2
    for number in range(board.n_corners // 4):
        up, i = divmod(number, cols)
        j = board.rows // 2 - 1 - up
        cells = cv2.aruco.generateImageMarker(dictionary, number, side, borderBits=BORDER) > 0
        # OpenCV's tags are upside down against those of the AprilTag library
        yield board.grid[2 * (j * board.cols + i)] * board.square_m, np.rot90(cells, 2)

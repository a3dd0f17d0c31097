"""AprilGrids as Kalibr prints them (kalibr_create_target_pdf): tags of 10 x 10 cells, tag 0 at the bottom left."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.patterns.charuco import predefined
from rgbd_calib.types import Board

BORDER = 2
"""Cells of black around a tag's code."""


def check(board: Board) -> None:
    """Raise ConfigError unless the board has whole tags, has tags enough, and they leave a gap."""
    if board.cols % 2 or board.rows % 2:
        raise ConfigError(
            f"board: {board.cols} x {board.rows} corners seen; an AprilGrid has two for each tag along columns and rows. "
            f"Take even numbers, such as {board.cols + board.cols % 2} x {board.rows + board.rows % 2}"
        )
    has = len(predefined(board.dictionary, "DICT_APRILTAG_").bytesList)
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
    dictionary = predefined(board.dictionary)
    side = dictionary.markerSize + 2 * BORDER
    cols = board.cols // 2
    for number in range(board.n_corners // 4):
        up, i = divmod(number, cols)
        j = board.rows // 2 - 1 - up
        cells = cv2.aruco.generateImageMarker(dictionary, number, side, borderBits=BORDER) > 0
        # OpenCV's tags are upside down against those of the AprilTag library
        yield board.grid[2 * (j * board.cols + i)] * board.square_m, np.rot90(cells, 2)

"""ChArUco boards, seen in whole or in part, by OpenCV."""

from __future__ import annotations

import cv2
import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, IntArray


def find_charuco(gray: np.ndarray, board: Board) -> tuple[IntArray, FloatArray] | None:
    """Numbers (n,) and rough pixels (n, 2) of the corners that are seen, or None."""
    corners, ids, _, _ = cv2.aruco.CharucoDetector(_layout(board)).detectBoard(gray)
    if ids is None or len(ids) == 0:
        return None
    return ids.ravel().astype(int), corners.reshape(-1, 2).astype(float)


def _layout(board: Board) -> cv2.aruco.CharucoBoard:
    number = getattr(cv2.aruco, board.dictionary, None) if board.dictionary.startswith("DICT_") else None
    if number is None:
        known = ", ".join(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
        raise ConfigError(
            f"board: dictionary {board.dictionary!r} seen, one of {known} needed. Correct it where the board is described"
        )
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    return cv2.aruco.CharucoBoard((board.cols + 1, board.rows + 1), board.square_m, board.marker_m, dictionary)

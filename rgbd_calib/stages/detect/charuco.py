"""ChArUco boards, seen in whole or in part, by OpenCV.

Up to OpenCV 4.6 boards with an even number of rows of squares began with a white square, and many are still in use: a
view in which the markers do not fit the present layout is read by the former one. Corners have the same numbers in both.
"""

from __future__ import annotations

import cv2
import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, IntArray


def find_charuco(gray: np.ndarray, board: Board) -> tuple[IntArray, FloatArray] | None:
    """Numbers (n,) and rough pixels (n, 2) of the corners that are seen, or None."""
    for legacy in (False, True) if board.rows % 2 == 1 else (False,):
        corners, ids, _, _ = cv2.aruco.CharucoDetector(_layout(board, legacy)).detectBoard(gray)
        if ids is not None and len(ids) >= 4:  # fewer make no homography
            return ids.ravel().astype(int), corners.reshape(-1, 2).astype(float)
    return None


def _layout(board: Board, legacy: bool) -> cv2.aruco.CharucoBoard:
    number = getattr(cv2.aruco, board.dictionary, None) if board.dictionary.startswith("DICT_") else None
    if number is None:
        known = ", ".join(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
        raise ConfigError(
            f"board: dictionary {board.dictionary!r} seen, one of {known} needed. Correct it where the board is described"
        )
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    layout = cv2.aruco.CharucoBoard((board.cols + 1, board.rows + 1), board.square_m, board.marker_m, dictionary)
    layout.setLegacyPattern(legacy)
    return layout

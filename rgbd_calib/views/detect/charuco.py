"""ChArUco boards, seen in whole or in part, by OpenCV.

Up to OpenCV 4.6 boards with an even number of rows of squares began with a white square, and many are still in use.
Part of such a board may look like part of the other with all its corners numbered wrongly by one, so the layout must be
given; a view whose markers fit the other one only is an error.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, IntArray

FIT_SQUARES = 0.2
"""RMS of the markers' corners about their homography, in sides of a square; a marker in the wrong place is off by 1."""


def find_charuco(gray: np.ndarray, board: Board) -> tuple[IntArray, FloatArray] | None:
    """Numbers (n,) and rough pixels (n, 2) of the corners that are seen, or None.

    Raises
    ------
    ConfigError
        An unknown dictionary, or the markers are those of the other layout.
    """
    layout = _layout(board, board.legacy)
    markers, numbers, _ = cv2.aruco.ArucoDetector(layout.getDictionary()).detectMarkers(gray)
    if numbers is None:
        return None
    if _misfit(layout, board.square_m, markers, numbers.ravel()) > FIT_SQUARES:
        if _misfit(_layout(board, not board.legacy), board.square_m, markers, numbers.ravel()) < FIT_SQUARES:
            seen, needed = ("true", "false") if board.legacy else ("false", "true")
            raise ConfigError(
                f"board: legacy is {seen}, but its markers lie as those of a board with legacy: {needed} (before OpenCV 4.6 "
                f"an even number of rows began with a white square). Set legacy: {needed} where the board is described"
            )
        return None
    corners, ids, _, _ = cv2.aruco.CharucoDetector(layout).detectBoard(gray, None, None, markers, numbers)
    if ids is None or len(ids) < 4:  # fewer make no homography
        return None
    return ids.ravel().astype(int), corners.reshape(-1, 2).astype(float)


def _misfit(layout: cv2.aruco.CharucoBoard, square_m: float, markers: Sequence[np.ndarray], numbers: IntArray) -> float:
    """RMS (sides of a square) of the markers' corners about one homography."""
    where = dict(zip(np.ravel(layout.getIds()).tolist(), layout.getObjPoints(), strict=True))
    seen = [(where[k], marker) for k, marker in zip(numbers.tolist(), markers, strict=True) if k in where]
    if len(seen) < 2:
        return np.inf
    on_board = np.concatenate([np.asarray(points)[:, :2] for points, _ in seen]).astype(float) / square_m
    in_image = np.concatenate([marker.reshape(-1, 2) for _, marker in seen]).astype(float)
    H, _ = cv2.findHomography(in_image, on_board)
    if H is None:
        return np.inf
    off = cv2.perspectiveTransform(in_image[:, None], H)[:, 0] - on_board
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def predefined(name: str) -> cv2.aruco.Dictionary:
    """The dictionary of markers that OpenCV calls so.

    Raises
    ------
    ConfigError
        There is none.
    """
    number = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if number is None:
        known = ", ".join(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
        raise ConfigError(
            f"board: dictionary {name!r} seen, one of {known} needed. Correct it where the board is described"
        )
    return cv2.aruco.getPredefinedDictionary(number)


def _layout(board: Board, legacy: bool) -> cv2.aruco.CharucoBoard:
    dictionary = predefined(board.dictionary)
    layout = cv2.aruco.CharucoBoard((board.cols + 1, board.rows + 1), board.square_m, board.marker_m, dictionary)
    layout.setLegacyPattern(legacy)
    return layout

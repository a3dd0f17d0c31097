"""ChArUco boards as OpenCV defines them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.types import Board


def check(board: Board) -> None:
    """Raise ConfigError unless OpenCV knows the dictionary, it has markers enough, and they fit the squares."""
    import cv2

    number = getattr(cv2.aruco, board.dictionary, None) if board.dictionary.startswith("DICT_") else None
    if number is None:
        known = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
        raise ConfigError(f"dictionary: '{board.dictionary}' seen, one of {', '.join(known)} needed")
    needed = (board.cols + 1) * (board.rows + 1) // 2
    has = len(cv2.aruco.getPredefinedDictionary(number).bytesList)
    if has < needed:
        raise ConfigError(
            f"dictionary: {board.dictionary} has {has} markers, {needed} are needed for {board.cols} x {board.rows} "
            "corners. Take a larger dictionary, as DICT_5X5_1000"
        )
    if not 0 < board.marker_m < board.square_m:
        raise ConfigError(
            f"marker: {board.marker_m:g} m seen, less than the square of {board.square_m:g} m is needed. "
            "Three quarters of the square is usual"
        )


def markers(board: Board) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Top left corner (3,), metres from the first square's outer corner, and cells (n, n), True = white, of each marker."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    layout = cv2.aruco.CharucoBoard((board.cols + 1, board.rows + 1), board.square_m, board.marker_m, dictionary)
    side = dictionary.markerSize + 2
    for number, corners_m in zip(np.ravel(layout.getIds()), layout.getObjPoints(), strict=True):
        yield np.asarray(corners_m[0], float), cv2.aruco.generateImageMarker(dictionary, int(number), side) > 0

"""ChArUco boards as OpenCV defines them."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.types import Board


def check(board: Board) -> None:
    """Raise ConfigError unless OpenCV knows the dictionary, it has markers enough, and they fit the squares."""
    needed = (board.cols + 1) * (board.rows + 1) // 2
    has = len(predefined(board.dictionary).bytesList)
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


def predefined(name: str, prefix: str = "DICT_") -> cv2.aruco.Dictionary:
    """The dictionary of markers that OpenCV calls so.

    Raises
    ------
    ConfigError
        There is none, or its name has not this prefix.
    """
    number = getattr(cv2.aruco, name, None) if name.startswith(prefix) else None
    if number is None:
        known = ", ".join(own for own in dir(cv2.aruco) if own.startswith(prefix))
        raise ConfigError(
            f"board: dictionary {name!r} seen, one of {known} needed. Correct it where the board is described"
        )
    return cv2.aruco.getPredefinedDictionary(number)


def layout(board: Board, legacy: bool | None = None) -> cv2.aruco.CharucoBoard:
    """The board as OpenCV has it, in its own layout or in one that is given."""
    squares, dictionary = (board.cols + 1, board.rows + 1), predefined(board.dictionary)
    own = cv2.aruco.CharucoBoard(squares, board.square_m, board.marker_m, dictionary)
    own.setLegacyPattern(board.legacy if legacy is None else legacy)
    return own


def markers(board: Board) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Top left corner (3,), metres from the first square's outer corner, and cells (n, n), True = white, of each marker."""
    own = layout(board)
    side = own.getDictionary().markerSize + 2
    for number, corners_m in zip(np.ravel(own.getIds()), own.getObjPoints(), strict=True):
        cells = cv2.aruco.generateImageMarker(own.getDictionary(), int(number), side) > 0
        yield np.asarray(corners_m[0], float), cells

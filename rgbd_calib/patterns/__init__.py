"""What is printed on a calibration board: one description for the printer and for the simulator."""

from __future__ import annotations

from dataclasses import replace

from rgbd_calib.patterns import aprilgrid, charuco
from rgbd_calib.types import APRILGRID_TAGS, Board, BoardType


def of_type(board: Board, kind: BoardType, marker_m: float | None = None, dictionary: str | None = None) -> Board:
    """A checkerboard's corners as a board of this type; None: the usual markers.

    Raises
    ------
    ConfigError
        There is no such board.
    """
    if kind == "charuco":
        marker_m = round(0.75 * board.square_m, 4) if marker_m is None else marker_m
        board = replace(board, type=kind, marker_m=marker_m, dictionary=dictionary or "DICT_5X5_250")
        charuco.check(board)
    elif kind == "aprilgrid":
        marker_m = round(board.square_m / 0.65, 6) if marker_m is None else marker_m  # Kalibr's usual spacing of 0.3
        board = replace(board, type=kind, marker_m=marker_m, dictionary=dictionary or APRILGRID_TAGS)
        aprilgrid.check(board)
    return board

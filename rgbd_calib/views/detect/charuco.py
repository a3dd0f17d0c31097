"""ChArUco boards, seen in whole or in part.

Up to OpenCV 4.6 boards with an even number of rows of squares began with a white square, and many are still in use.
Part of such a board may look like part of the other with all its corners numbered wrongly by one, so the layout must be
given; a view whose markers fit the other one only is an error.
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.patterns.charuco import layout, predefined
from rgbd_calib.types import Board
from rgbd_calib.views.detect.markers import find_markers, fitting
from rgbd_calib.views.detect.subpixel import Surroundings


def find_charuco(gray: np.ndarray, board: Board) -> tuple[FloatArray, FloatArray, Surroundings] | None:
    """Corners of markers (k, 2), in squares from corner (0, 0) and px, and what is around the board's corners; or None.

    Raises
    ------
    ConfigError
        An unknown dictionary, or the markers are those of the other layout.
    """
    here, other = (_markers(board, legacy) for legacy in (board.legacy, not board.legacy))
    markers_px, numbers = find_markers(gray, predefined(board.dictionary), len(here))
    fits, misfit = fitting(here[numbers], markers_px)
    if fitting(other[numbers], markers_px)[0].sum() > fits.sum():
        seen, needed = ("true", "false") if board.legacy else ("false", "true")
        raise ConfigError(
            f"board: legacy is {seen}, but its markers lie as those of a board with legacy: {needed} (before OpenCV 4.6 "
            f"an even number of rows began with a white square). Set legacy: {needed} where the board is described"
        )
    if np.isinf(misfit):
        return None
    clear = Surroundings((1 - board.marker_m / board.square_m) / 2)
    return here[numbers][fits].reshape(-1, 2), markers_px[fits].reshape(-1, 2), clear


def _markers(board: Board, legacy: bool) -> FloatArray:
    """Corners (n, 4, 2) of the markers, in squares from corner (0, 0)."""
    return np.array(layout(board, legacy).getObjPoints(), float)[..., :2] / board.square_m - 1

"""The board in one image: its corners to a few hundredths of a pixel, and the depth under them.

A checkerboard is found in four steps. :mod:`.saddles` finds saddle points of the brightness; :mod:`.grids` links them to
grids; :mod:`.checkerboard` selects the grid that has the board's numbers of columns and rows, and checks the colours of
its squares; :mod:`.subpixel` fits a model to the brightness around each corner, and drops outliers. A ChArUco board
(:mod:`.charuco`) or an AprilGrid (:mod:`.aprilgrid`) may be seen in part. :mod:`.depth` gives the depth.

Order of the corners: columns and rows make a right-handed pair in the image (x right, y down), and where cols + rows
is odd the inner square next to corner (0, 0) is black; where it is even, a half turn stays undecided here.
"""

from __future__ import annotations

import cv2
import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, BoardView, IntArray
from rgbd_calib.views.detect.aprilgrid import find_aprilgrid
from rgbd_calib.views.detect.charuco import find_charuco
from rgbd_calib.views.detect.checkerboard import find_checkerboard, grid_sizes, orient
from rgbd_calib.views.detect.depth import corner_depth
from rgbd_calib.views.detect.markers import corners_around
from rgbd_calib.views.detect.params import DetectParams
from rgbd_calib.views.detect.subpixel import refine

__all__ = [
    "DetectParams",
    "corner_depth",
    "detect_view",
    "find_corners",
    "grid_sizes",
    "orient",
    "refine",
    "with_depth",
]


def find_corners(
    gray: np.ndarray, board: Board, params: DetectParams | None = None
) -> tuple[IntArray, FloatArray] | None:
    """Corner numbers (n,) and pixels (n, 2) of the board in a grey image (h, w) uint8, or None.

    A checkerboard is found whole, though corners that something covers may be missing; a ChArUco board or an AprilGrid may
    be seen in part.

    Raises
    ------
    ConfigError
        A board that cannot be found in any image: its quarter turns look alike, or its dictionary is unknown.
    """
    params = params or DetectParams()
    if board.type != "checkerboard":
        markers = (find_charuco if board.type == "charuco" else find_aprilgrid)(gray, board)
        if markers is None:
            return None
        ids, corners_px = corners_around(gray, board, *markers)
        return (ids, corners_px) if len(ids) >= params.min_corners else None
    if board.cols == board.rows:
        raise ConfigError(
            f"board: {board.cols} x {board.rows} inner corners; a board with as many columns as rows looks the same "
            "when rotated by 90°. Use a board with different numbers"
        )
    found = find_checkerboard(gray, board, params)
    if found is None:
        return None
    ids, corners_px = found
    corners_px, good = refine(gray, board.grid[ids], corners_px)
    if good.sum() < max(params.min_corners, params.min_share * len(ids)):
        return None
    return ids[good], corners_px[good]


def detect_view(
    camera: str, frame: str, color: np.ndarray, depth_m: FloatArray | None, board: Board, params: DetectParams
) -> BoardView | None:
    """The board in a colour image (h, w, 3) uint8 and its depth image (h, w), metres, or None where it is not seen."""
    found = find_corners(cv2.cvtColor(color, cv2.COLOR_BGR2GRAY), board, params)
    return None if found is None else with_depth(camera, frame, found, depth_m, board)


def with_depth(
    camera: str, frame: str, found: tuple[IntArray, FloatArray], depth_m: FloatArray | None, board: Board
) -> BoardView:
    """Corners, as :func:`find_corners` returns them, with their depth from the image (h, w), metres."""
    ids, corners_px = found
    if depth_m is None:
        depth, pixels = np.full(len(ids), np.nan), np.zeros(len(ids), int)
    else:
        depth, pixels = corner_depth(depth_m, board, ids, corners_px, np.random.default_rng(0))
    return BoardView(camera, frame, ids, corners_px, depth, pixels)

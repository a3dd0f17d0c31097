"""AprilGrids, the boards of Kalibr, seen in whole or in part, by OpenCV's detector of markers.

Tag 0 is at the bottom left, numbers rise to the right and then upwards; small black squares fill the corners between the
tags, so that each corner of a tag is a crossing of two edges (E. Olson, AprilTag, ICRA 2011; kalibr_create_target_pdf).
Kalibr's tags have a border of two cells, those of other programs one, and programs differ in which way up a tag is.
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.patterns.charuco import predefined
from rgbd_calib.types import APRILGRID_TAGS, Board, IntArray
from rgbd_calib.views.detect.markers import find_markers, fitting
from rgbd_calib.views.detect.subpixel import Surroundings

BORDERS = (2, 1)
"""Cells of black around a tag's code, as they are tried."""
CLEARLY = 0.5
"""The right way up fits better than any other by this factor."""


def find_aprilgrid(gray: np.ndarray, board: Board) -> tuple[FloatArray, FloatArray, Surroundings] | None:
    """Corners of tags (k, 2), in squares from corner (0, 0) and px, and what is around the board's corners; or None.

    Raises
    ------
    ConfigError
        An unknown dictionary.
    """
    dictionary = predefined(board.dictionary or APRILGRID_TAGS)
    for border in BORDERS:
        tags_px, numbers = find_markers(gray, dictionary, board.n_corners // 4, border, touching=True)
        found = _upright(board, tags_px, numbers)
        if found is not None:
            return *found, _surroundings(board, border / (dictionary.markerSize + 2 * border))
    return None


def _upright(board: Board, tags_px: FloatArray, numbers: IntArray) -> tuple[FloatArray, FloatArray] | None:
    """Corners on the board and in the image of tags (n, 4, 2), each clockwise from its own first corner; None where they fit no
    board."""
    up, i = np.divmod(numbers, board.cols // 2)
    j = board.rows // 2 - 1 - up
    c, r = 2 * i[:, None] + [0, 1, 1, 0], 2 * j[:, None] + [0, 0, 1, 1]
    turns = [board.grid[np.roll(r * board.cols + c, turn, axis=1)] for turn in range(4)]
    fits = [fitting(on_board, tags_px) for on_board in turns]
    best, second = np.argsort([misfit for _, misfit in fits])[:2]
    if np.isinf(fits[best][1]) or fits[best][1] > CLEARLY * fits[second][1]:
        return None
    mine = fits[best][0]
    return turns[best][mine].reshape(-1, 2), tags_px[mine].reshape(-1, 2)


def _surroundings(board: Board, border: float) -> Surroundings:
    """Beside a tag's sides there is its border, and the gap to the next tag; the gap's width is that of the small squares.

    Parameters
    ----------
    border
        Over the side of a tag.
    """
    tag = board.marker_m / board.square_m
    gap = 2 - tag
    return Surroundings(beside=min(border * tag, gap), along=gap)

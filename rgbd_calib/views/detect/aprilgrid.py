"""AprilGrids, the boards of Kalibr, seen in whole or in part, by OpenCV's detector of markers.

Tag 0 is at the bottom left, numbers rise to the right and then upwards; small black squares fill the corners between the
tags, so that each corner of a tag is a crossing of two edges (E. Olson, AprilTag, ICRA 2011; kalibr_create_target_pdf).
Kalibr's tags have a border of two cells, those of other programs one, and programs differ in which way up a tag is.
"""

from __future__ import annotations

import cv2
import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import APRILGRID_TAGS, Board, IntArray
from rgbd_calib.views.detect.charuco import predefined
from rgbd_calib.views.detect.subpixel import Surroundings

BORDERS = (2, 1)
"""Cells of black around a tag's code, as they are tried."""
WINDOW_MAX_PX = 10
FIT_SQUARES = 0.5
"""Of the tags' corners from their homography, in squares; room for a wide lens, where a tag that is turned by a quarter has
corners that are off by more than 1."""
CLEARLY = 0.5
"""The right way up fits better than any other by this factor."""


def find_aprilgrid(gray: np.ndarray, board: Board) -> tuple[IntArray, FloatArray, Surroundings] | None:
    """Numbers (n,) and rough pixels (n, 2) of the corners that are seen, and what is around them; or None.

    Raises
    ------
    ConfigError
        An unknown dictionary.
    """
    dictionary = predefined(board.dictionary or APRILGRID_TAGS)
    for border in BORDERS:
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = border
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        parameters.cornerRefinementWinSize = WINDOW_MAX_PX
        parameters.relativeCornerRefinmentWinSize = float(
            border
        )  # in cells: what is black on one side and white on the other
        tags, numbers, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(gray)
        found = None if numbers is None else _number(board, np.reshape(tags, (-1, 4, 2)), numbers.ravel())
        if found is not None:
            return *found, _surroundings(board, border / (dictionary.markerSize + 2 * border))
    return None


def _number(board: Board, tags_px: FloatArray, numbers: IntArray) -> tuple[IntArray, FloatArray] | None:
    """Corner numbers and pixels of tags (n, 4, 2), each clockwise from its own first corner; None where they fit no board."""
    names, counts = np.unique(numbers, return_counts=True)
    tags = board.n_corners // 4
    once = np.isin(numbers, names[counts == 1]) & (numbers < tags)  # the same tag twice: another board, or a mirror
    if once.sum() < 2:
        return None
    up, i = np.divmod(numbers[once], board.cols // 2)
    j = board.rows // 2 - 1 - up
    c, r = 2 * i[:, None] + [0, 1, 1, 0], 2 * j[:, None] + [0, 0, 1, 1]
    ids, pixels = r * board.cols + c, tags_px[once].astype(float)
    misfits = [_misfit(board.grid[np.roll(ids, turn, axis=1).ravel()], pixels.reshape(-1, 2)) for turn in range(4)]
    best = int(np.argmin(misfits))
    second = float(np.partition(misfits, 1)[1])
    if misfits[best] > FIT_SQUARES or misfits[best] > CLEARLY * second:
        return None
    ids = np.roll(ids, best, axis=1).ravel()
    order = np.argsort(ids)
    return ids[order], pixels.reshape(-1, 2)[order]


def _misfit(on_board: FloatArray, in_image: FloatArray) -> float:
    """Median distance (squares) from one homography that does not mirror; a tag that is misread leaves it as it is."""
    H, _ = cv2.findHomography(in_image, on_board, cv2.LMEDS)
    if H is None or np.linalg.det(H * np.sign(H[2] @ [*in_image[0], 1.0])) <= 0:
        return np.inf
    off = cv2.perspectiveTransform(in_image[:, None], H)[:, 0] - on_board
    return float(np.median(np.linalg.norm(off, axis=1)))


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

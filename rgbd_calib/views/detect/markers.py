"""Boards with markers: the markers by OpenCV, then all corners that the board has around them.

Markers that are far away are decoded best in an enlarged image, each cell by its middle alone: edges blur into all else. Two
markers tell where every corner should be. Each is fitted where it should be, next to corners that are known, and is kept if it
looks like a corner and lies with the others; so corners are found whose markers are not.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial import cKDTree

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, IntArray
from rgbd_calib.views.detect.subpixel import Surroundings, refine, robust_homography

ENLARGED_PX = 1600
"""Images up to this side are enlarged twice to look for markers."""
WINDOW_MAX_PX = 20
PIXELS_PER_CELL, MARGIN = 5, 0.4
"""A marker's cell is rectified to so many pixels a side, and read without this share at each border: by one pixel."""
FIT_SQUARES = 0.5
"""Of a marker's corners from the homography, in squares; room for a wide lens, where a marker that is misread or turned by a
quarter has corners that are off by more."""
MOST = 0.75
"""Share of the markers that fit; half may fit a wrong layout."""
REACH_SQUARES = 1.6
"""Corners are looked for so near to known ones, where a lens moves both alike."""
RIM_PX = 3
"""Corners nearer to the image's border have lost too much of what is around them."""


def find_markers(
    gray: np.ndarray, dictionary: cv2.aruco.Dictionary, count: int, border: int = 1, touching: bool = False
) -> tuple[FloatArray, IntArray]:
    """Corners (n, 4, 2), px, of the first `count` markers of a dictionary, and their numbers (n,), each once.

    Parameters
    ----------
    border
        Cells of black around a marker's code.
    touching
        The markers' corners are crossings, and their outlines run into what touches them there.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border
    if touching:
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        parameters.cornerRefinementWinSize = WINDOW_MAX_PX
        parameters.relativeCornerRefinmentWinSize = float(border)  # in cells: black on one side, white on the other
    parameters.perspectiveRemovePixelPerCell = PIXELS_PER_CELL
    parameters.perspectiveRemoveIgnoredMarginPerCell = MARGIN
    own = cv2.aruco.Dictionary(dictionary.bytesList[:count], dictionary.markerSize, dictionary.maxCorrectionBits)
    scale = 2 if max(gray.shape) <= ENLARGED_PX else 1
    image = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC) if scale > 1 else gray
    found, numbers, _ = cv2.aruco.ArucoDetector(own, parameters).detectMarkers(image)
    if numbers is None:
        return np.zeros((0, 4, 2)), np.zeros(0, int)
    corners_px = (np.reshape(found, (-1, 4, 2)).astype(float) + 0.5) / scale - 0.5
    names, counts = np.unique(numbers.ravel(), return_counts=True)
    once = np.isin(numbers.ravel(), names[counts == 1])  # the same marker twice: another board, or a mirror
    return corners_px[once], numbers.ravel()[once]


def fitting(on_board: FloatArray, in_image: FloatArray) -> tuple[np.ndarray, float]:
    """Which markers (n,) lie together, of corners (n, 4, 2) in squares and in px, and their median misfit, squares.

    It is inf where fewer than two do, or not most of them. The homography does not mirror; a marker that is misread leaves it as
    it is.
    """
    board, image = on_board.reshape(-1, 2), in_image.reshape(-1, 2)
    H = cv2.findHomography(image, board, cv2.LMEDS)[0] if len(on_board) >= 2 else None
    if H is None or np.linalg.det(H * np.sign(H[2] @ [*image[0], 1.0])) <= 0:
        return np.zeros(len(on_board), bool), np.inf
    off = np.linalg.norm(cv2.perspectiveTransform(image[:, None], H)[:, 0] - board, axis=1).reshape(-1, 4)
    fits = off.max(axis=1) < FIT_SQUARES
    enough = fits.sum() >= max(2, MOST * len(fits))
    return fits, float(np.median(off)) if enough else np.inf


def corners_around(
    gray: np.ndarray, board: Board, known: FloatArray, known_px: FloatArray, clear: Surroundings
) -> tuple[IntArray, FloatArray]:
    """Numbers (n,) and pixels (n, 2) of the corners that are seen.

    Parameters
    ----------
    known, known_px
        Points (k, 2) of the board, in squares from corner (0, 0), and about where they are in the image.
    """
    ids, corners_px = np.zeros(0, int), np.zeros((0, 2))
    while True:
        expected, near = _expected(board.grid, known, known_px)
        high = np.array(gray.shape[::-1]) - 1 - RIM_PX
        tried = np.flatnonzero(near & np.all((expected >= RIM_PX) & (expected <= high), axis=1))
        fitted, good = refine(gray, board.grid[tried], expected[tried], clear)
        if good.sum() < len(ids) or not _spread(board.grid[tried[good]]):
            return ids, corners_px
        before, ids, corners_px = len(ids), tried[good], fitted[good]
        if len(ids) == before:  # and fitted once more, in windows about where they are
            return ids, corners_px
        known, known_px = board.grid[ids], corners_px


def _expected(grid: FloatArray, known: FloatArray, known_px: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Where points (n, 2) of the board are in the image, by a homography and what the nearest known point is off it; and which
    are near enough to one (n,)."""
    H = robust_homography(known, known_px)
    if H is None:
        return grid, np.zeros(len(grid), bool)
    distance, nearest = cKDTree(known).query(grid)
    on_plane = cv2.perspectiveTransform(np.concatenate([known, grid])[:, None], H)[:, 0]
    off = known_px - on_plane[: len(known)]
    return np.asarray(on_plane[len(known) :] + off[nearest]), np.asarray(distance < REACH_SQUARES)


def _spread(grid: FloatArray) -> bool:
    """Do corners (n, 2) of a board determine a homography: two rows, two corners in each?"""
    return bool((np.unique(grid[:, 1], return_counts=True)[1] >= 2).sum() >= 2)

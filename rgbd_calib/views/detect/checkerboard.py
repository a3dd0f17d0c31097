"""A whole checkerboard in an image, by OpenCV's finders; the positions are refined elsewhere."""

from __future__ import annotations

import cv2
import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, IntArray
from rgbd_calib.views.detect.params import DetectParams
from rgbd_calib.views.detect.saddles import board_corners

LOOK_AT = 3
"""So many times the board's corners are looked at by the quick look, the strongest first."""
LOOKS_LIKE = 0.6
"""Share of the board's corners that the quick look must see. All views of the simulated and real recordings that any
finder of OpenCV finds have it; with the board painted over, 0.52 is the most (scripts/benchmark_detection.py)."""
ALTERNATE = 0.9
"""Share of the pairs of squares side by side that must change from dark to bright in the board's order."""


def find_checkerboard(gray: np.ndarray, board: Board, params: DetectParams) -> tuple[IntArray, FloatArray] | None:
    """Numbers (n,) and rough pixels (n, 2) of all corners, in the order of the package's head, or None."""
    box = _where(gray, board)
    if box is None:
        return None
    x0, y0, x1, y1 = box
    for search in (_plain, _enlarged, _by_sectors)[: 3 if params.escalate else 1]:
        corners = search(np.ascontiguousarray(gray[y0:y1, x0:x1]), (board.cols, board.rows))
        if corners is None:
            continue
        grid = orient(gray, (corners + [x0, y0]).reshape(board.rows, board.cols, 2))
        if alternates(gray, grid):
            return np.arange(board.n_corners), grid.reshape(-1, 2)
    return None


def orient(gray: np.ndarray, grid: FloatArray) -> FloatArray:
    """The corner grid (rows, cols, 2), px, in the order that the package's head defines."""
    if np.linalg.det(np.stack([grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]])) < 0:
        grid = grid[:, ::-1]
    rows, cols = grid.shape[:2]
    shade, even = _shades(gray, grid), _even(rows, cols)
    first_is_white = np.median(shade[even]) > np.median(shade[~even])
    return grid[::-1, ::-1] if (rows + cols) % 2 == 1 and first_is_white else grid


def alternates(gray: np.ndarray, grid: FloatArray) -> bool:
    """Do the inner squares of a corner grid (rows, cols, 2) change from dark to bright and back, side by side?"""
    rows, cols = grid.shape[:2]
    shade = np.where(_even(rows, cols), 1, -1) * _shades(gray, grid)
    # with the sign of the first colour, a step to the square beside it is the sum of the two
    steps = np.concatenate([(shade[1:] + shade[:-1]).ravel(), (shade[:, 1:] + shade[:, :-1]).ravel()])
    return bool(max(np.mean(steps > 0), np.mean(steps < 0)) >= ALTERNATE) if len(steps) else True


def _even(rows: int, cols: int) -> np.ndarray:
    even: np.ndarray = np.add.outer(np.arange(rows - 1), np.arange(cols - 1)) % 2 == 0
    return even


def _shades(gray: np.ndarray, grid: FloatArray) -> FloatArray:
    """Brightness (rows - 1, cols - 1) at the middles of the inner squares."""
    middles = ((grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4).astype(np.float32)
    shades: FloatArray = cv2.remap(
        gray, middles[..., 0], middles[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    ).astype(float)
    return shades


def _where(gray: np.ndarray, board: Board) -> tuple[int, int, int, int] | None:
    """x0, y0, x1, y1 around what looks like the board, or None; an image out of focus is looked at reduced too."""
    for reduced in (1, 2):
        small = gray if reduced == 1 else cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        seen = reduced * board_corners(small, LOOK_AT * board.n_corners)
        if len(seen) >= LOOKS_LIKE * board.n_corners:
            low, high = seen.min(axis=0), seen.max(axis=0)
            margin = 20 + 0.35 * (high - low)  # the outer squares and the paper around them
            (x0, y0), (x1, y1) = (
                np.maximum(low - margin, 0).astype(int),
                np.minimum(high + margin, gray.shape[::-1]).astype(int),
            )
            return int(x0), int(y0), int(x1), int(y1)
    return None


def _plain(gray: np.ndarray, size: tuple[int, int]) -> FloatArray | None:
    ok, corners = cv2.findChessboardCorners(gray, size, flags=cv2.CALIB_CB_ADAPTIVE_THRESH)
    return corners.reshape(-1, 2).astype(float) if ok else None


def _enlarged(gray: np.ndarray, size: tuple[int, int]) -> FloatArray | None:
    twice = cv2.resize(gray, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    corners = _plain(twice, size)
    return None if corners is None else (corners - 0.5) / 2  # the middle of pixel 0 is at 0.5 px of the larger image


def _by_sectors(gray: np.ndarray, size: tuple[int, int]) -> FloatArray | None:
    ok, corners = cv2.findChessboardCornersSB(gray, size, flags=cv2.CALIB_CB_EXHAUSTIVE)
    return corners.reshape(-1, 2).astype(float) if ok else None

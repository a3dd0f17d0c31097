"""A whole checkerboard in an image: the grid of saddle points that has its numbers of columns and rows.

The image is searched at several scales, until the board is found: at half size, which finds most boards, at a quarter of the
cost and with less noise and blur; at full size, for squares below some 12 px; at a quarter of its size, for images far out
of focus. If full size shows part of a grid of small squares, that part is searched enlarged.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, IntArray
from rgbd_calib.views.detect.grids import Grid, find_grids
from rgbd_calib.views.detect.params import DetectParams
from rgbd_calib.views.detect.saddles import MOST, find_saddles

ALTERNATE = 0.9
"""Share of the pairs of squares side by side that must change from dark to bright in the board's order."""
MIN_SEEN = 0.6
"""Share of the corners that must be detected; the places of the rest are predicted, and the refinement judges them."""
MAX_BEYOND = 0.3
"""Share of a line beside the board that may look like corners: a grid that continues is another board, or none."""
LEAST_PX = 16
"""Images with a shorter side are skipped: the squares of 3 x 3 corners would be 4 px."""
ENLARGED_PX = 14.0
"""Grids of smaller squares are searched enlarged."""


def find_checkerboard(gray: np.ndarray, board: Board, params: DetectParams) -> tuple[IntArray, FloatArray] | None:
    """Numbers (n,) and rough pixels (n, 2) of all corners, in the order of the package's head, or None."""
    for grids in _looks(gray, (board.cols, board.rows), params.escalate):
        fitting = [corners for corners in (_as_board(grid, board, gray.shape) for grid in grids) if corners is not None]
        for corners in sorted(fitting, key=_area, reverse=True):
            ordered = orient(gray, corners)
            if alternates(gray, ordered):
                return np.arange(board.n_corners), ordered.reshape(-1, 2)
    return None


def grid_sizes(gray: np.ndarray) -> list[tuple[int, int]]:
    """Inner corners, (columns, rows) with the larger number first, of all checkerboards in a grey image (h, w) uint8, the
    largest board first; empty where there is none. Part of a board counts as what is visible of it."""
    best: list[Grid] = []
    for grids in _looks(gray, None, False):
        if grids and (not best or grids[0].n_seen > best[0].n_seen):
            best = grids
    return [(max(grid.shape), min(grid.shape)) for grid in best]


def _looks(gray: np.ndarray, size: tuple[int, int] | None, enlarge: bool) -> Iterator[list[Grid]]:
    """Grids, in px of the whole image, of one look after another, for a grid of `size` or for any."""
    if min(gray.shape) < LEAST_PX:
        return
    half = _halved(gray)
    yield _seen(half, size, 2)
    fine = _seen(gray, size, 1)
    yield fine
    yield _seen(_halved(half), size, 4)
    if enlarge and fine and fine[0].side_px < ENLARGED_PX:
        yield _enlarged(gray, size, fine[0])


def _halved(gray: np.ndarray) -> np.ndarray:
    h, w = gray.shape
    return cv2.resize(gray[: h // 2 * 2, : w // 2 * 2], (w // 2, h // 2), interpolation=cv2.INTER_AREA)


def _seen(
    gray: np.ndarray, size: tuple[int, int] | None, reduced: float, corner: tuple[int, int] = (0, 0)
) -> list[Grid]:
    """Grids of an image that shows `reduced` px of the whole one in each of its own, from `corner` on."""
    if min(gray.shape) < LEAST_PX:
        return []
    most = MOST if size is None else max(MOST, 4 * size[0] * size[1])
    grids = find_grids(find_saddles(gray, most), size)
    return [Grid((grid.px + 0.5) * reduced - 0.5 + corner, grid.seen, grid.beyond) for grid in grids]


def _enlarged(gray: np.ndarray, size: tuple[int, int] | None, grid: Grid) -> list[Grid]:
    low, high = np.nanmin(grid.px, axis=(0, 1)), np.nanmax(grid.px, axis=(0, 1))
    margin = 20 + 0.5 * (high - low)
    x0, y0 = np.maximum(low - margin, 0).astype(int).tolist()
    x1, y1 = np.minimum(high + margin, gray.shape[::-1]).astype(int).tolist()
    part = cv2.resize(gray[y0:y1, x0:x1], None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    return _seen(part, size, 0.5, (x0, y0))


def _as_board(grid: Grid, board: Board, shape: tuple[int, ...]) -> FloatArray | None:
    """Corners (rows, cols, 2) of a grid of the board's size that lies in an image (h, w), or None."""
    px = grid.px if grid.shape == (board.rows, board.cols) else grid.px.transpose(1, 0, 2)
    if px.shape[:2] != (board.rows, board.cols) or grid.n_seen < MIN_SEEN * board.n_corners or grid.beyond > MAX_BEYOND:
        return None
    return px if np.all((px >= 0) & (px <= np.array(shape[::-1]) - 1)) else None


def _area(grid: FloatArray) -> float:
    return float(cv2.contourArea(cv2.convexHull(grid.reshape(-1, 2).astype(np.float32))))


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

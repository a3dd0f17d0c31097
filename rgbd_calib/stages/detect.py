"""Checkerboard corners and the depth under them, in one image.

Order of the corners: columns and rows make a right-handed pair in the image (x right, y down), and where cols + rows
is odd the inner square next to corner (0, 0) is black; where it is even, a half turn stays undecided here.

Depth of a corner: a plane has an inverse depth that is affine in the (undistorted) pixel, 1/z = a u + b v + c, and the
noise of a triangulating sensor is constant in 1/z. So the board's pixels are fitted by that plane robustly, pixels off
the plane are dropped, and each corner takes the plane's value at it plus the mean of what the pixels of its own cell
(half a square to each side) deviate: cells are disjoint, so no two corners share a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Board, BoardView, IntArray

MIN_CELL_FILL = 0.3
"""A corner has depth where at least this share of its cell's pixels lies on the board's plane."""
MIN_CORNERS = 6
"""Fewer corners of a ChArUco board than this make no view."""
OUTLIER_SIGMAS = 4.0
PLANE_SAMPLES = 100
NOISE_FLOOR_PER_M = 1e-3
"""The scatter of 1/z about the plane is taken for at least this: 1 mm at 1 m, 4 mm at 2 m. Most pixels of a board may
share one step of the disparity, and their median deviation be zero."""
WINDOW_SQUARES = 0.5
"""Half a window's side over the shortest distance to a neighbour. The finders of OpenCV are off by up to 0.3 px for a
whole board at once; cv2.cornerSubPix with this window leaves 0.04 px that are independent from corner to corner."""
WINDOW_MAX_PX = 10
"""Beyond it a lens bends the squares' sides: the errors grow again, and not independently."""


@dataclass(frozen=True)
class DetectParams:
    escalate: bool = True
    """Search again, harder and slower, where the plain search finds no board."""


def find_corners(
    gray: np.ndarray, board: Board, params: DetectParams | None = None
) -> tuple[IntArray, FloatArray] | None:
    """Corner numbers (n,) and pixels (n, 2) of the board in a grey image (h, w) uint8, or None.

    A checkerboard is found whole; a ChArUco board may be seen in part.
    """
    if board.type == "charuco":
        return _find_charuco(gray, board)
    if board.cols == board.rows:
        raise ConfigError(
            f"board: {board.cols} x {board.rows} inner corners; a board with as many columns as rows cannot be told from "
            "its quarter turns. Use a board with different numbers"
        )
    found = _find_checkerboard(gray, board, params or DetectParams())
    if found is None:
        return None
    ids = np.arange(board.n_corners)
    corners_px = refine(gray, ids, found, board.cols)
    return ids, orient(gray, corners_px.reshape(board.rows, board.cols, 2)).reshape(-1, 2)


def refine(gray: np.ndarray, ids: IntArray, corners_px: FloatArray, cols: int) -> FloatArray:
    """Corners (n, 2), px, where the gradients around them meet, each window as wide as its squares allow."""
    reach = np.clip(np.round(WINDOW_SQUARES * _spacing(ids, corners_px, cols)), 2, WINDOW_MAX_PX).astype(int)
    out = corners_px.copy()
    for half in np.unique(reach):
        some = reach == half
        start = np.ascontiguousarray(corners_px[some, None], np.float32)
        stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-3)
        out[some] = cv2.cornerSubPix(gray, start, (int(half), int(half)), (-1, -1), stop)[:, 0]
    return out


def _spacing(ids: IntArray, corners_px: FloatArray, cols: int) -> FloatArray:
    """Distance (n,), px, from each corner to the nearest of its neighbours on the board, inf where there are none."""
    r, c = np.divmod(ids, cols)
    beside = np.abs(np.subtract.outer(r, r)) + np.abs(np.subtract.outer(c, c)) == 1
    apart = np.linalg.norm(corners_px[:, None] - corners_px, axis=-1)
    nearest: FloatArray = np.where(beside, apart, np.inf).min(axis=1)
    return nearest


def orient(gray: np.ndarray, grid: FloatArray) -> FloatArray:
    """The corner grid (rows, cols, 2), px, in the order that the module's head defines."""
    if np.linalg.det(np.stack([grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]])) < 0:
        grid = grid[:, ::-1]
    rows, cols = grid.shape[:2]
    centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    x, y = np.round(centres).astype(int).reshape(-1, 2).T
    shade = gray[np.clip(y, 0, gray.shape[0] - 1), np.clip(x, 0, gray.shape[1] - 1)].astype(float)
    even = np.add.outer(np.arange(rows - 1), np.arange(cols - 1)).ravel() % 2 == 0
    first_is_white = np.median(shade[even]) > np.median(shade[~even])
    return grid[::-1, ::-1] if (rows + cols) % 2 == 1 and first_is_white else grid


def corner_depth(
    depth_m: FloatArray, board: Board, ids: IntArray, corners_px: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, IntArray]:
    """Depth (n,), metres, NaN where there is none, and how many pixels each rests on (n,).

    Parameters
    ----------
    depth_m : (h, w), metres, NaN where there is no measurement.
    ids, corners_px : (n,), (n, 2) as :func:`find_corners` returns them.
    """
    n = len(ids)
    nothing = np.full(n, np.nan), np.zeros(n, int)
    cell, u, v, size = _cells(depth_m.shape, board, ids, corners_px)
    q = 1.0 / depth_m[v, u]
    valid = np.isfinite(q)
    if valid.sum() < 3 * MIN_CORNERS:
        return nothing
    cell, q = cell[valid], q[valid]
    centre = corners_px.mean(axis=0)  # keeps the plane's normal equations well conditioned
    A = np.column_stack([u[valid] - centre[0], v[valid] - centre[1], np.ones(valid.sum())])
    plane, scale = _least_median(A, q, rng)
    for _ in range(3):
        on_plane = np.abs(q - A @ plane) < OUTLIER_SIGMAS * scale
        plane = np.linalg.lstsq(A[on_plane], q[on_plane], rcond=None)[0]
        scale = float(np.sqrt(np.mean((q - A @ plane)[on_plane] ** 2))) + 1e-12
    residual = np.where(on_plane, q - A @ plane, 0.0)
    count = np.bincount(cell[on_plane], minlength=n)
    deviation = np.bincount(cell, residual, minlength=n) / np.maximum(count, 1)
    at_corner = np.column_stack([corners_px - centre, np.ones(n)]) @ plane + deviation
    good = (count >= np.maximum(MIN_CELL_FILL * size, 3)) & (at_corner > 0)
    return np.where(good, 1.0 / np.where(good, at_corner, 1.0), np.nan), np.where(good, count, 0)


def detect_view(
    camera: str, frame: str, color: np.ndarray, depth_m: FloatArray | None, board: Board, params: DetectParams
) -> BoardView | None:
    """The board in a colour image (h, w, 3) uint8 and its depth image (h, w), metres, or None where it is not seen."""
    found = find_corners(cv2.cvtColor(color, cv2.COLOR_BGR2GRAY), board, params)
    if found is None:
        return None
    ids, corners_px = found
    if depth_m is None:
        depth, pixels = np.full(len(ids), np.nan), np.zeros(len(ids), int)
    else:
        depth, pixels = corner_depth(depth_m, board, ids, corners_px, np.random.default_rng(0))
    return BoardView(camera, frame, ids, corners_px, depth, pixels)


def _find_checkerboard(gray: np.ndarray, board: Board, params: DetectParams) -> FloatArray | None:
    size = (board.cols, board.rows)
    ok, corners = cv2.findChessboardCornersSB(gray, size, flags=0)
    if not ok and params.escalate:
        ok, corners = cv2.findChessboardCornersSB(gray, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not ok and params.escalate:
        ok, corners = cv2.findChessboardCornersSB(gray, size, flags=cv2.CALIB_CB_EXHAUSTIVE)
    return corners.reshape(-1, 2).astype(float) if ok else None


def _find_charuco(gray: np.ndarray, board: Board) -> tuple[IntArray, FloatArray] | None:
    dictionary = getattr(cv2.aruco, board.dictionary, None)
    if dictionary is None:
        raise ConfigError(f"board.dictionary: {board.dictionary!r} seen, a name of cv2.aruco as DICT_5X5_250 needed")
    shape = (board.cols + 1, board.rows + 1)
    charuco = cv2.aruco.CharucoBoard(
        shape, board.square_m, board.marker_m, cv2.aruco.getPredefinedDictionary(dictionary)
    )
    corners, ids, _, _ = cv2.aruco.CharucoDetector(charuco).detectBoard(gray)
    if ids is None or len(ids) < MIN_CORNERS:
        return None
    return ids.ravel().astype(int), corners.reshape(-1, 2).astype(float)


def _cells(
    shape: tuple[int, ...], board: Board, ids: IntArray, corners_px: FloatArray
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Pixels of the corners' cells: row of the corner, u, v (each (m,)), and each cell's size in pixels (n,)."""
    r, c = np.divmod(ids, board.cols)
    H, _ = cv2.findHomography(corners_px, np.column_stack([c, r]).astype(float))
    H = H * np.sign(H[2] @ [*corners_px[0], 1.0])  # positive on the board's side of the vanishing line
    reach = np.ceil(np.ptp(corners_px, axis=0) / max(min(board.cols, board.rows) - 1, 1) + 2)
    lo = np.maximum(np.floor(corners_px.min(axis=0) - reach), 0).astype(int)
    hi = np.minimum(np.ceil(corners_px.max(axis=0) + reach), [shape[1] - 1, shape[0] - 1]).astype(int)
    u, v = (g.ravel() for g in np.meshgrid(np.arange(lo[0], hi[0] + 1), np.arange(lo[1], hi[1] + 1)))
    on_board = np.column_stack([u, v, np.ones(len(u))]) @ H.T
    col, row = np.round(on_board[:, :2] / on_board[:, 2:]).astype(int).T
    row_of = np.full(board.n_corners, -1)
    row_of[ids] = np.arange(len(ids))
    inside = (col >= 0) & (col < board.cols) & (row >= 0) & (row < board.rows) & (on_board[:, 2] > 0)
    cell = np.where(inside, row_of[np.where(inside, row * board.cols + col, 0)], -1)
    keep = cell >= 0
    return cell[keep], u[keep], v[keep], np.bincount(cell[keep], minlength=len(ids))


def _least_median(A: FloatArray, q: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, float]:
    """Least median of squares (P. Rousseeuw, 1984): parameters and a robust sigma; up to half may be outliers."""
    thin = rng.choice(len(q), min(len(q), 500), replace=False)
    A, q = A[thin], q[thin]
    triples = rng.integers(len(q), size=(PLANE_SAMPLES, 3))
    usable = np.abs(np.linalg.det(A[triples])) > 1e-3 * np.ptp(A[:, :2])  # the triangle's area, against slivers
    candidates = np.concatenate(
        [
            np.linalg.solve(A[triples][usable], q[triples][usable][..., None])[..., 0],
            [np.linalg.lstsq(A, q, rcond=None)[0]],
        ]
    )
    medians = np.median(np.abs(candidates @ A.T - q), axis=1)
    best = int(np.argmin(medians))
    return candidates[best], max(1.4826 * float(medians[best]), NOISE_FLOOR_PER_M)

"""Pictures of AprilGrids with known poses, for tests."""

from __future__ import annotations

import cv2
import numpy as np

from rgbd_calib.geometry import se3, so3
from rgbd_calib.report import board_sheet
from rgbd_calib.types import APRILGRID_TAGS, Board

GRID = Board(12, 8, 0.039, type="aprilgrid", marker_m=0.06, dictionary=APRILGRID_TAGS)
WIDTH, HEIGHT = 640, 480
K = np.array([[560.0, 0, 319.5], [0, 560.0, 239.5], [0, 0, 1]])
FINE = 4
PX_PER_MM = 4
MARGIN_MM = 30.0


def drawing(board: Board) -> tuple[np.ndarray, np.ndarray]:
    """The print as pixels, and the motion (3, 3) from metres on the board to them."""
    width, height = board_sheet.pattern_mm(board)
    at = board_sheet.rim_mm(board) + MARGIN_MM
    image = np.full([round((side + 2 * MARGIN_MM) * PX_PER_MM) for side in (height, width)], 255, np.uint8)
    for fill in board_sheet.pattern(board, at, at):
        for x, y, w, h in fill.rectangles:
            x0, y0, x1, y1 = (round(v * PX_PER_MM) for v in (x, y, x + w, y + h))
            image[y0:y1, x0:x1] = 0
    scale, shift = 1000 * PX_PER_MM, at * PX_PER_MM - 0.5
    return image, np.array([[scale, 0, shift], [0, scale, shift], [0, 0, 1.0]])


def project(board: Board, T: np.ndarray) -> np.ndarray:
    p = board.corners_m() @ T[:3, :3].T + T[:3, 3]
    return p[:, :2] / p[:, 2:] @ K[:2, :2].T + K[:2, 2]


def photograph(board: Board, T: np.ndarray, rng: np.random.Generator, printed: Board | None = None) -> np.ndarray:
    """The board at T_color_board, grey (h, w), with blur and noise."""
    image, pixels_of_board = drawing(printed or board)
    H = K @ np.column_stack([T[:3, 0], T[:3, 1], T[:3, 3]]) @ np.linalg.inv(pixels_of_board)
    fine = np.array([[FINE, 0, (FINE - 1) / 2], [0, FINE, (FINE - 1) / 2], [0, 0, 1.0]])
    size = (WIDTH * FINE, HEIGHT * FINE)
    big = cv2.warpPerspective(image, fine @ H, size, flags=cv2.INTER_LINEAR, borderValue=160)
    small = cv2.GaussianBlur(cv2.resize(big, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), (0, 0), 0.6)
    return np.clip(0.6 * small + 40 + rng.normal(0, 2, small.shape), 0, 255).astype(np.uint8)


def pose(rng: np.random.Generator, board: Board, roll_rad: float, z_m: float = 0.75) -> np.ndarray:
    """T_color_board with the middle of the board near the optical axis."""
    R = so3.exp(np.array([*rng.uniform(-0.4, 0.4, 2), 0.0])) @ so3.exp(np.array([0, 0, roll_rad]))
    return se3.make(R, np.array([*rng.uniform(-0.05, 0.05, 2), z_m]) - R @ board.corners_m().mean(axis=0))


def plane_depth(T: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], axis=-1)
    return (T[:3, 2] @ T[:3, 3]) / (rays @ T[:3, 2])

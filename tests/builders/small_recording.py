"""A small recording with a known rig, drawn in a second: a board before a textured wall, by homographies."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from rgbd_calib.io.recording import CameraInfo, save_color, save_depth, write_dataset
from rgbd_calib.types import Board

WIDTH, HEIGHT, FOCAL_PX, WALL_M = 640, 480, 575.0, 4.0
BOARD = Board(9, 6, 0.06)
_PX_PER_SQUARE = 40
K = np.array([[FOCAL_PX, 0, (WIDTH - 1) / 2], [0, FOCAL_PX, (HEIGHT - 1) / 2], [0, 0, 1]])


def draw_recording(folder: Path, cameras: int = 3, frames: int = 6, seed: int = 0) -> Path:
    """Cameras 0.3 m apart in a row, turned to a point 2 m before the row; the board in another pose in each frame."""
    rng = np.random.default_rng(seed)
    names = [f"C{i + 1}" for i in range(cameras)]
    wall = cv2.resize(rng.integers(60, 200, (24, 32, 3), np.uint8), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    for n in range(frames):
        T_world_board = _board_pose(n, rng)
        for i, name in enumerate(names):
            T_color_board = np.linalg.inv(camera_pose(i, cameras)) @ T_world_board
            color, depth_raw = _draw(T_color_board, wall)
            noise = rng.integers(-2, 3, color.shape)
            save_color(folder, name, f"{n:06d}", np.clip(color + noise, 0, 255).astype(np.uint8))
            save_depth(folder, name, f"{n:06d}", depth_raw)
    write_dataset(folder, {name: CameraInfo(WIDTH, HEIGHT, serial=f"drawn-{name}") for name in names}, BOARD)
    return folder


def camera_pose(i: int, cameras: int) -> np.ndarray:
    """T_world_color of camera `i`; the first one is the world."""
    x = 0.3 * i
    turn = np.arctan2(0.3 * (cameras - 1) / 2 - x, 2.0) - np.arctan2(0.3 * (cameras - 1) / 2, 2.0)
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.array([0.0, turn, 0.0]))[0]
    T[:3, 3] = T[:3, :3] @ [0, 0, 0] + [x, 0, 0]
    return T


def _board_pose(n: int, rng: np.random.Generator) -> np.ndarray:
    tilt = rng.uniform(-0.5, 0.5, 3) * [1.0, 1.0, 0.2]
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(tilt)[0]
    middle = BOARD.corners_m().mean(axis=0)
    place = np.array([rng.uniform(0.0, 0.6), rng.uniform(-0.15, 0.15), 1.4 + 0.15 * (n % 5)])
    T[:3, 3] = place - T[:3, :3] @ middle
    return T


def _draw(T_color_board: np.ndarray, wall: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    columns, rows = BOARD.cols + 3, BOARD.rows + 3  # squares, with a white border of one
    y, x = np.mgrid[0 : rows * _PX_PER_SQUARE, 0 : columns * _PX_PER_SQUARE] // _PX_PER_SQUARE
    inside = (x > 0) & (y > 0) & (x < columns - 1) & (y < rows - 1)
    print_px = np.where(inside & ((x + y) % 2 == 0), 30, 225).astype(np.uint8)
    # picture of the print -> board's frame, metres: corner (0, 0) lies two squares in
    scale = BOARD.square_m / _PX_PER_SQUARE
    M = np.array(
        [
            [scale, 0, (0.5 / _PX_PER_SQUARE - 2) * BOARD.square_m],
            [0, scale, (0.5 / _PX_PER_SQUARE - 2) * BOARD.square_m],
            [0, 0, 1],
        ]
    )
    R, t = T_color_board[:3, :3], T_color_board[:3, 3]
    H = K @ np.column_stack([R[:, 0], R[:, 1], t]) @ M
    size = (WIDTH * 2, HEIGHT * 2)  # drawn twice as large, then averaged: no stairs at the edges
    double = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1]])
    big = cv2.warpPerspective(print_px, double @ H, size, flags=cv2.INTER_AREA)
    mask = cv2.warpPerspective(np.full_like(print_px, 255), double @ H, size, flags=cv2.INTER_NEAREST)
    small = cv2.resize(big, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    on_board = cv2.resize(mask, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA) == 255
    color = np.where(on_board[..., None], small[..., None], wall)
    normal = R[:, 2]
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    rays = np.stack([(u - K[0, 2]) / FOCAL_PX, (v - K[1, 2]) / FOCAL_PX, np.ones_like(u)], axis=-1)
    depth_m = np.where(on_board, (normal @ t) / (rays @ normal), WALL_M)
    return color.astype(np.uint8), np.rint(depth_m * 1000).astype(np.uint16)

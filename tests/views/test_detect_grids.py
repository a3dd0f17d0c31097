"""Boards that are hard to find, several boards, parts of boards, and things that are none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rgbd_calib.geometry import so3
from rgbd_calib.types import Board
from rgbd_calib.views.detect import find_corners, grid_sizes

BOARD = Board(9, 6, 0.06)
WIDTH, HEIGHT, FINE = 640, 480, 3
FOCAL = 500.0
MIDDLE = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])


def grid_of(board):
    return np.stack(np.divmod(np.arange(board.n_corners), board.cols)[::-1], axis=1).astype(float)


def pose(board, distance, R=None, aside=(0.0, 0.0)):
    """Axes of the board as columns, and its corner (0, 0), in squares: its middle is `distance` before the camera."""
    R = np.eye(3) if R is None else R
    middle = np.array([*aside, distance])
    return R[:, :2], middle - R[:, :2] @ (np.array([board.cols, board.rows]) - 1) / 2


def corners_px(board, axes, t, fisheye=False):
    p = grid_of(board) @ axes.T + t
    if not fisheye:
        return FOCAL * p[:, :2] / p[:, 2:] + MIDDLE
    r = np.linalg.norm(p[:, :2], axis=1, keepdims=True)
    return FOCAL / 2 * np.arctan2(r, p[:, 2:]) * p[:, :2] / r + MIDDLE


def draw(boards, rng, fisheye=False, blur_px=0.6, noise=2.0, light=None):
    """Boards [(board, (axes, t)), ...] on white paper before a grey wall, (h, w) uint8."""
    y, x = (np.mgrid[: HEIGHT * FINE, : WIDTH * FINE] + 0.5) / FINE - 0.5
    off = np.stack([x, y], axis=-1) - MIDDLE
    if fisheye:
        angle = np.linalg.norm(off, axis=-1, keepdims=True) / (FOCAL / 2)
        rays = np.concatenate([np.sinc(angle / np.pi) * off / (FOCAL / 2), np.cos(angle)], axis=-1)
    else:
        rays = np.concatenate([off / FOCAL, np.ones((*off.shape[:2], 1))], axis=-1)
    image = np.full(rays.shape[:2], 120.0)
    for board, (axes, t) in boards:
        on = rays @ np.linalg.inv(np.column_stack([axes, t])).T
        ahead = on[..., 2] > 1e-9
        c, r = (np.where(ahead, on[..., k] / np.where(ahead, on[..., 2], 1), -9.0) for k in (0, 1))
        inside = {m: (c > -m) & (c < board.cols - 1 + m) & (r > -m) & (r < board.rows - 1 + m) for m in (1.0, 1.7)}
        dark = inside[1.0] & ((np.floor(c) + np.floor(r)) % 2 == 0)
        image = np.where(inside[1.7], np.where(dark, 40.0, 190.0), image)
    image = image.reshape(HEIGHT, FINE, WIDTH, FINE).mean(axis=(1, 3))
    if light is not None:
        image = image * light
    image = cv2.GaussianBlur(image, (0, 0), blur_px) + rng.normal(0, noise, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def turned(tilt_deg, about_deg, turn_deg):
    a = np.deg2rad(about_deg)
    return so3.exp(np.deg2rad(tilt_deg) * np.array([np.cos(a), np.sin(a), 0])) @ so3.exp(
        np.array([0, 0, np.deg2rad(turn_deg)])
    )


def assert_found(gray, board, true_px, within_px):
    """Every corner that is reported; those on a shadow's edge may be dropped."""
    found = find_corners(gray, board)
    assert found is not None
    ids, px = found
    assert len(ids) >= 0.9 * board.n_corners
    assert np.abs(px - true_px[ids]).max() < within_px


SHADOW = np.where(np.arange(WIDTH) < WIDTH / 2 + 7, 1.0, 0.25)
HARD = {
    "8 px squares": {"distance": FOCAL / 8},
    "tilt": {"R": turned(68, 40, 10), "distance": FOCAL / 32},
    "blur": {"distance": FOCAL / 30, "blur_px": 3.0},
    "noise": {"distance": FOCAL / 30, "noise": 20.0},
    "shadow": {"distance": FOCAL / 30, "light": SHADOW},
    "little light": {"distance": FOCAL / 30, "light": 0.1},
}


@pytest.mark.parametrize("kind", HARD)
def test_hard_boards_are_found(kind):
    rng, how = np.random.default_rng(0), dict(HARD[kind])
    placed = pose(BOARD, how.pop("distance"), how.pop("R", turned(20, 70, 15)))
    gray = draw([(BOARD, placed)], rng, **how)
    assert_found(gray, BOARD, corners_px(BOARD, *placed), 0.5)


@pytest.mark.parametrize("aside", [0.0, 4.0, 8.0])
def test_a_fisheye_may_bend_the_board(aside):
    """At 8 squares aside of 6, corners are up to 65 degrees off the axis."""
    rng = np.random.default_rng(1)
    placed = pose(BOARD, 6.0, turned(15, 30, 5), (aside, 0.0))
    gray = draw([(BOARD, placed)], rng, fisheye=True)
    assert_found(gray, BOARD, corners_px(BOARD, *placed, fisheye=True), 0.3)


def test_of_several_boards_the_stated_one_is_taken():
    rng, other = np.random.default_rng(2), Board(7, 4, 0.05)
    left = pose(BOARD, FOCAL / 24, turned(20, 0, 8), (-6.5, 0.0))
    right = pose(other, FOCAL / 24, turned(20, 90, -12), (7.0, 0.0))
    gray = draw([(BOARD, left), (other, right)], rng)
    assert_found(gray, BOARD, corners_px(BOARD, *left), 0.2)
    assert_found(gray, other, corners_px(other, *right), 0.2)
    assert grid_sizes(gray) == [(9, 6), (7, 4)]


@pytest.mark.parametrize("stated", [Board(10, 7, 0.06), Board(8, 5, 0.06), Board(8, 6, 0.06), Board(6, 5, 0.06)])
def test_a_board_of_another_size_is_not_found_and_its_size_is_told(stated):
    rng = np.random.default_rng(3)
    gray = draw([(BOARD, pose(BOARD, FOCAL / 30, turned(30, 20, 100)))], rng)
    assert find_corners(gray, stated) is None
    assert grid_sizes(gray) == [(9, 6)]


def test_a_board_that_the_border_cuts_is_not_found():
    rng = np.random.default_rng(4)
    gray = draw([(BOARD, pose(BOARD, FOCAL / 40, aside=(4.8, 0.0)))], rng)  # the last column is 10 px beyond
    assert find_corners(gray, BOARD) is None


def test_covered_corners_are_left_out():
    rng = np.random.default_rng(5)
    placed = pose(BOARD, FOCAL / 40)
    gray, true_px = draw([(BOARD, placed)], rng), corners_px(BOARD, *placed)
    covered = [12, 13, 30]
    for k in covered:
        cv2.circle(gray, np.rint(true_px[k]).astype(int).tolist(), 14, 130, -1)
    ids, px = find_corners(gray, BOARD)
    assert set(covered).isdisjoint(ids) and len(ids) >= BOARD.n_corners - 5
    assert np.abs(px - true_px[ids]).max() < 0.3


def texture(kind, rng):
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    u, v = (x * np.cos(0.2) + y * np.sin(0.2)) / 23, (y * np.cos(0.2) - x * np.sin(0.2)) / 23
    if kind == "gingham":
        return 130 + 50 * np.sin(np.pi * u) + 50 * np.sin(np.pi * v)
    if kind == "bricks":
        shifted = u + 0.5 * (np.floor(v) % 2)
        return np.where((shifted % 1 < 0.1) | (v % 1 < 0.1), 200.0, 90.0)
    if kind == "code":
        lot = rng.random((90, 90)) < 0.5
        return np.where(lot[np.floor(v).astype(int) % 90, np.floor(u).astype(int) % 90], 40.0, 200.0)
    if kind == "endless board":
        return np.where((np.floor(u) + np.floor(v)) % 2 == 0, 40.0, 200.0)
    return 128 + 40 * cv2.GaussianBlur(rng.standard_normal(x.shape), (0, 0), 3) * 10


@pytest.mark.parametrize("kind", ["gingham", "bricks", "code", "endless board", "noise"])
@pytest.mark.parametrize("board", [BOARD, Board(5, 4, 0.06)], ids=str)
def test_textures_are_no_boards(kind, board):
    rng = np.random.default_rng(6)
    image = cv2.GaussianBlur(texture(kind, rng), (0, 0), 0.8) + rng.normal(0, 2, (HEIGHT, WIDTH))
    assert find_corners(np.clip(image, 0, 255).astype(np.uint8), board) is None


@pytest.mark.parametrize("shape", [(1, 1), (5, 400), (40, 7), (17, 33)])
def test_small_images_have_no_board(shape):
    gray = np.random.default_rng(7).integers(0, 255, shape).astype(np.uint8)
    assert find_corners(gray, BOARD) is None
    assert grid_sizes(gray) == []

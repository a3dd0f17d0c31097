"""Corners of boards in drawn images: where they are, which is which, which to leave out, and the depth under them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.recording import open_recording
from rgbd_calib.patterns.charuco import layout
from rgbd_calib.types import Board
from rgbd_calib.views.detect import (
    DetectParams,
    checkerboard,
    corner_depth,
    detect_view,
    find_corners,
    grids,
    orient,
    refine,
)
from rgbd_calib.views.detect.saddles import find_saddles
from rgbd_calib.views.detect.subpixel import _crossing

BOARD = Board(9, 6, 0.06)
CHARUCO = Board(8, 5, 0.06, type="charuco", marker_m=0.045, dictionary="DICT_5X5_250")
WIDTH, HEIGHT, FINE = 300, 280, 6
SIGMA_GREY, BLUR_PX = 1.5, 0.6


def grid_of(board):
    return np.stack(np.divmod(np.arange(board.n_corners), board.cols)[::-1], axis=1).astype(float)


def place(board, rng, side_px=20.0, turn_rad=0.0):
    """A homography from the grid to the image, and the corners (n, 2), px."""
    outer = np.array([[0, 0], [board.cols - 1, 0], [board.cols - 1, board.rows - 1], [0, board.rows - 1]], float)
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    wobble = rng.uniform(-0.5, 0.5, (4, 2)) * side_px
    middle = [(WIDTH - 1) / 2, (HEIGHT - 1) / 2]
    there = (outer - outer.mean(axis=0)) @ np.array([[c, s], [-s, c]]) * side_px + wobble + middle
    H = cv2.getPerspectiveTransform(outer.astype(np.float32), there.astype(np.float32)).astype(float)
    return H, cv2.perspectiveTransform(grid_of(board)[:, None], H)[:, 0]


def develop(fine, rng, rise=None):
    """A picture of FINE x FINE samples a pixel, 0 to 1, as a camera gives it; light may rise by `rise` (2,), 1/px."""
    light = fine.reshape(HEIGHT, FINE, WIDTH, FINE).mean(axis=(1, 3))
    if rise is not None:
        y, x = np.mgrid[:HEIGHT, :WIDTH] - np.array([HEIGHT, WIDTH])[:, None, None] / 2
        seen = cv2.GaussianBlur((0.05 + 0.45 * light) * (1 + rise[0] * x + rise[1] * y), (0, 0), BLUR_PX)
        return np.clip(np.round(255 * seen ** (1 / 2.2) + rng.normal(0, SIGMA_GREY, light.shape)), 0, 255).astype(
            np.uint8
        )
    light = cv2.GaussianBlur(40 + 150 * light, (0, 0), BLUR_PX)
    return np.clip(np.round(light + rng.normal(0, SIGMA_GREY, light.shape)), 0, 255).astype(np.uint8)


def on_board(H):
    """Grid coordinates (h, w), (h, w) of the fine samples."""
    y, x = np.mgrid[: HEIGHT * FINE, : WIDTH * FINE]
    u, v = (x + 0.5) / FINE - 0.5, (y + 0.5) / FINE - 0.5
    a = np.linalg.inv(H)
    w = a[2, 0] * u + a[2, 1] * v + a[2, 2]
    return (a[0, 0] * u + a[0, 1] * v + a[0, 2]) / w, (a[1, 0] * u + a[1, 1] * v + a[1, 2]) / w


def draw(board, H, rng, rise=None):
    """A checkerboard; the inner square beside corner (0, 0) is black, white paper around, a grey wall behind."""
    c, r = on_board(H)
    black = (np.floor(c) + np.floor(r)) % 2 == 0
    squares = (c > -1) & (c < board.cols) & (r > -1) & (r < board.rows)
    paper = (c > -1.7) & (c < board.cols + 0.7) & (r > -1.7) & (r < board.rows + 0.7)
    return develop(np.where(squares, 1.0 - black, np.where(paper, 1.0, 0.4)), rng, rise)


def draw_charuco(board, H, rng):
    side = 40
    print_px = layout(board).generateImage(((board.cols + 1) * side, (board.rows + 1) * side))
    c, r = on_board(H)
    x, y = np.floor((c + 1) * side).astype(int), np.floor((r + 1) * side).astype(int)
    inside = (x >= 0) & (y >= 0) & (x < print_px.shape[1]) & (y < print_px.shape[0])
    x, y = np.clip(x, 0, print_px.shape[1] - 1), np.clip(y, 0, print_px.shape[0] - 1)
    return develop(np.where(inside, print_px[y, x] / 255, 1.0), rng)


# One edge of length L px and contrast C, blurred by s, with noise sigma: variance of its place is
# sigma^2 2 sqrt(pi) s / (L C^2). Here L = 0.9 * 20, C = 150, s^2 = 0.6^2 + 1/12: 0.004 px. The drawing itself puts an
# edge to 1/6 px in each row of pixels, sd (1/6)/sqrt(12)/sqrt(18) = 0.011 px. Shared parameters (directions, blur,
# background) cost less than a factor of 2 in all.
SIGMA_PX = 2 * np.hypot(0.004, 0.011)


@pytest.mark.parametrize("seed", range(4))
def test_corners_are_accurate_and_the_board_as_a_whole_is_not_shifted(seed):
    rng = np.random.default_rng(seed)
    H, true_px = place(BOARD, rng, turn_rad=rng.uniform(-0.4, 0.4))
    ids, corners_px = find_corners(draw(BOARD, H, rng), BOARD)
    error = corners_px - true_px[ids]
    assert len(ids) == BOARD.n_corners
    assert np.sqrt(np.mean(error**2)) < SIGMA_PX
    assert np.abs(error.mean(axis=0)).max() < 4 * SIGMA_PX / np.sqrt(len(ids))  # independent errors


@pytest.mark.parametrize("rise", [(0.0, -0.003), (0.003, 0.0)])
def test_a_light_from_one_side_does_not_draw_the_board_to_it(rise):
    """What twelve boards are shifted by in common is left in every pose; 0.005 px without a model of the light."""
    shifts = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        H, true_px = place(BOARD, rng, turn_rad=rng.uniform(-0.4, 0.4))
        ids, corners_px = find_corners(draw(BOARD, H, rng, rise), BOARD)
        shifts.append((corners_px - true_px[ids]).mean(axis=0))
    sure = np.std(shifts) / np.sqrt(len(shifts))
    assert np.abs(np.mean(shifts, axis=0)).max() < 3 * sure
    assert sure < 0.001


def test_the_model_has_the_derivatives_that_it_says():
    rng = np.random.default_rng(0)
    p, light = np.array([[0.3, -0.2, 0.1, 1.7, 100, 60, -0.2]]), np.array([0.005, -0.003])
    dx, dy = rng.uniform(-5, 5, (2, 30))
    jacobian = _crossing(p, light, dx, dy)[1]
    for k in range(7):
        step = np.zeros((1, 7))
        step[0, k] = 1e-6
        slope = (_crossing(p + step, light, dx, dy)[0] - _crossing(p - step, light, dx, dy)[0]) / 2e-6
        assert np.allclose(jacobian[:, k], slope, atol=1e-4)  # the Jacobian is kept in single precision


@pytest.mark.parametrize("quarter_turns", range(4))
def test_the_first_corner_is_the_same_however_the_board_is_turned(quarter_turns):
    rng = np.random.default_rng(quarter_turns)
    H, true_px = place(BOARD, rng, turn_rad=quarter_turns * np.pi / 2 + 0.1)
    ids, corners_px = find_corners(draw(BOARD, H, rng), BOARD)
    assert np.abs(corners_px - true_px[ids]).max() < 0.5


def test_a_half_turn_of_a_symmetric_board_stays_undecided_but_never_mirrored():
    rng, board = np.random.default_rng(1), Board(10, 6, 0.025)
    H, true_px = place(board, rng, turn_rad=0.2)
    _, corners_px = find_corners(draw(board, H, rng), board)
    assert min(np.abs(corners_px - order).max() for order in (true_px, true_px[::-1])) < 0.5


def test_the_detectors_own_order_does_not_matter():
    rng = np.random.default_rng(2)
    H, true_px = place(BOARD, rng)
    gray, grid = draw(BOARD, H, rng), true_px.reshape(BOARD.rows, BOARD.cols, 2)
    for given in (grid, grid[:, ::-1], grid[::-1], grid[::-1, ::-1]):
        assert np.array_equal(orient(gray, given), grid)


def test_a_wrong_start_is_repaired_and_a_covered_corner_left_out():
    rng = np.random.default_rng(3)
    H, true_px = place(BOARD, rng)
    gray = draw(BOARD, H, rng)
    start = true_px.copy()
    start[13] += [12.0, -8.0]  # 0.7 squares
    cv2.circle(gray, np.round(true_px[31]).astype(int).tolist(), 9, 140, -1)
    corners_px, good = refine(gray, grid_of(BOARD), start)
    assert np.flatnonzero(~good).tolist() == [31]
    assert np.abs(corners_px - true_px)[good].max() < 0.5


def test_squares_must_alternate():
    rng = np.random.default_rng(4)
    H, true_px = place(BOARD, rng)
    gray, grid = draw(BOARD, H, rng), true_px.reshape(BOARD.rows, BOARD.cols, 2)
    assert checkerboard.alternates(gray, grid)
    assert not checkerboard.alternates(gray, grid.mean(axis=(0, 1)) + 0.5 * (grid - grid.mean(axis=(0, 1))))
    assert not checkerboard.alternates(rng.integers(0, 255, gray.shape).astype(np.uint8), grid)


def test_no_grid_is_grown_in_an_image_without_a_board(monkeypatch):
    rng = np.random.default_rng(5)
    monkeypatch.setattr(grids, "_grown", lambda *_: pytest.fail("a grid was grown"))
    clutter = cv2.resize(rng.integers(0, 255, (6, 8), np.uint8), (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
    noise = rng.integers(0, 255, (HEIGHT, WIDTH), np.uint8)
    for gray in (clutter, noise, np.full((HEIGHT, WIDTH), 128, np.uint8)):
        assert find_corners(gray, BOARD) is None


def test_the_strongest_saddles_are_the_corners():
    rng = np.random.default_rng(6)
    H, true_px = place(BOARD, rng, side_px=9.0)
    seen = find_saddles(draw(BOARD, H, rng), 2 * BOARD.n_corners).px
    near = np.linalg.norm(true_px[:, None] - seen, axis=-1).min(axis=1) < 0.5
    assert near.mean() > 0.9


def test_a_board_that_cannot_be_told_from_its_quarter_turns_is_refused():
    with pytest.raises(ConfigError, match="different numbers"):
        find_corners(np.zeros((HEIGHT, WIDTH), np.uint8), Board(6, 6, 0.06))


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("covered", [0.0, 0.5])
def test_charuco_corners_have_the_boards_numbers(legacy, covered):
    rng, board = np.random.default_rng(7), replace(CHARUCO, legacy=legacy)
    H, true_px = place(board, rng, side_px=26.0, turn_rad=0.2)
    gray = draw_charuco(board, H, rng)
    gray[:, : int(covered * WIDTH)] = 120
    ids, corners_px = find_corners(gray, board)
    assert len(ids) >= (board.n_corners if covered == 0 else 10) * 0.8
    assert np.sqrt(np.mean((corners_px - true_px[ids]) ** 2)) < 2 * SIGMA_PX  # half the pixels: markers take the rest


def test_the_other_charuco_layout_is_an_error_not_a_wrong_number():
    rng, printed = np.random.default_rng(7), replace(CHARUCO, legacy=True)
    H, _ = place(printed, rng, side_px=26.0, turn_rad=0.2)
    with pytest.raises(ConfigError, match="Set legacy: true"):
        find_corners(draw_charuco(printed, H, rng), CHARUCO)


def test_an_unknown_dictionary_is_named():
    board = Board(8, 5, 0.06, type="charuco", marker_m=0.045, dictionary="DICT_5X5_25")
    with pytest.raises(ConfigError, match=r"DICT_5X5_25'.*DICT_5X5_250"):
        find_corners(np.zeros((HEIGHT, WIDTH), np.uint8), board)


def plane_depth(rng, noise=0.0016):
    """A tilted plane's depth (HEIGHT, WIDTH), metres, with triangulation noise."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    inverse = 0.5 + 2e-4 * (x - 200) - 3e-4 * (y - 150)
    return 1 / (inverse + rng.normal(0, noise, inverse.shape))


def test_depth_of_corners_is_the_planes_in_spite_of_a_hand_and_holes():
    rng = np.random.default_rng(8)
    _, corners_px = place(BOARD, rng, side_px=20.0)
    depth_m = plane_depth(rng)
    hand = corners_px[0].astype(int)
    depth_m[hand[1] - 15 : hand[1] + 15, hand[0] - 15 : hand[0] + 15] = 1.2  # covers the cell of corner 0, and more
    hole = corners_px[40].astype(int)
    depth_m[hole[1] - 15 : hole[1] + 15, hole[0] - 15 : hole[0] + 15] = np.nan
    depth_m[rng.random(depth_m.shape) < 0.3] = np.nan
    depth, pixels = corner_depth(depth_m, BOARD, np.arange(54), corners_px, rng)
    assert np.isnan(depth[[0, 40]]).all() and (pixels[[0, 40]] == 0).all()
    has = np.isfinite(depth)
    assert has.sum() >= 54 - 2 * 4  # a hand of 30 px takes one cell and parts of its neighbours
    x, y = corners_px.T
    exact = 1 / (0.5 + 2e-4 * (x - 200) - 3e-4 * (y - 150))
    sigma = (
        0.0016 * exact**2 / np.sqrt(pixels.clip(1)) * 1.1
    )  # the plane adds a 54th of the variance, outliers a little
    assert np.all(np.abs(depth - exact)[has] < 5 * sigma[has])


def test_a_view_without_depth_keeps_its_corners():
    rng = np.random.default_rng(9)
    H, _ = place(BOARD, rng)
    color = np.repeat(draw(BOARD, H, rng)[..., None], 3, axis=2)
    view = detect_view("C1", "000000", color, None, BOARD, DetectParams())
    assert len(view.ids) == 54 and np.isnan(view.depth_m).all() and not view.depth_pixels.any()
    blind = detect_view("C1", "000000", color, np.full((HEIGHT, WIDTH), np.nan), BOARD, DetectParams())
    assert np.isnan(blind.depth_m).all()


@pytest.mark.parametrize("name, views", [("realsense3", 30), ("percipio4_vga", 4)])
def test_no_board_of_the_real_recordings_is_lost(real_data, name, views):
    recording = open_recording(real_data(name))
    found = [
        find_corners(cv2.cvtColor(recording.color(camera, frame), cv2.COLOR_BGR2GRAY), recording.board)
        for camera, frames in recording.color_files.items()
        for frame in frames
    ]
    assert sum(corners is not None for corners in found) == views

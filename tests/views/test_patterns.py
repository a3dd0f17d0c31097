"""What is black on a board: as OpenCV and Kalibr draw it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from april_views import GRID

from rgbd_calib.errors import ConfigError
from rgbd_calib.patterns import charuco, of_type
from rgbd_calib.patterns.black import lattice, rectangles_m, rim_m
from rgbd_calib.types import Board

PLAIN = Board(8, 5, 0.06)
CHARUCO = of_type(PLAIN, "charuco")
BOARDS = {"checkerboard": PLAIN, "charuco": CHARUCO, "legacy": replace(CHARUCO, legacy=True), "aprilgrid": GRID}


@pytest.mark.parametrize("name", BOARDS)
def test_a_place_is_black_where_a_rectangle_covers_it(name):
    board, rng = BOARDS[name], np.random.default_rng(0)
    low, high = -2 * board.square_m, board.grid[-1] * board.square_m + 2 * board.square_m
    places = rng.uniform(low, high, (5000, 2))
    from_corner = places[:, None] - rectangles_m(board)[:, :2]
    covered = np.all((from_corner >= 0) & (from_corner < rectangles_m(board)[:, 2:]), axis=2)
    assert covered.sum(axis=1).max() == 1  # none overlap: a PDF would paint the overlap white
    assert np.array_equal(lattice(board).is_black(*places.T), covered.any(axis=1))
    assert 0.2 < covered.any(axis=1).mean() < 0.6


@pytest.mark.parametrize("legacy", [False, True])
def test_a_charuco_board_is_black_where_opencv_draws_it_black(legacy):
    board, side = replace(CHARUCO, legacy=legacy), 80  # markers of 60 px, 7 cells: edges are at fractions of a pixel
    image = charuco.layout(board).generateImage((9 * side, 6 * side)) > 127
    y, x = (np.indices(image.shape) + 0.5) * board.square_m / side - board.square_m
    assert np.mean(lattice(board).is_black(x, y) == image) < 0.02


def test_two_quadrants_of_each_corner_of_an_aprilgrid_are_black():
    places, out = GRID.grid * GRID.square_m, 0.3 * rim_m(GRID)
    c, r = np.divmod(np.arange(GRID.n_corners), GRID.cols)[::-1]
    outward = np.stack([2 * (c % 2) - 1, 2 * (r % 2) - 1], axis=1)
    for sides, black in (((1, 1), True), ((-1, -1), True), ((1, -1), False), ((-1, 1), False)):
        assert np.all(lattice(GRID).is_black(*(places + out * outward * sides).T) == black)


def test_types_have_the_usual_markers_and_are_checked():
    assert of_type(PLAIN, "checkerboard") == PLAIN
    assert (CHARUCO.marker_m, CHARUCO.dictionary) == (0.045, "DICT_5X5_250")
    grid = of_type(replace(PLAIN, rows=6), "aprilgrid")
    assert grid.dictionary == "DICT_APRILTAG_36h11" and grid.marker_m == pytest.approx(0.06 / 0.65, abs=1e-6)
    with pytest.raises(ConfigError, match="Take even numbers, such as 8 x 6"):
        of_type(PLAIN, "aprilgrid")
    with pytest.raises(ConfigError, match="DICT_4X4_50 has 50 markers, 76 are needed"):
        of_type(Board(18, 7, 0.02), "charuco", dictionary="DICT_4X4_50")

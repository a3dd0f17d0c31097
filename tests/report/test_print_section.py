"""The print in the report: its corners, shear and height against the design."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rgbd_calib.geometry import so3
from rgbd_calib.report import print_map
from rgbd_calib.types import Board, BoardShape

BOARD = Board(9, 6, 0.06)


def printed(A: np.ndarray, height_m: np.ndarray | float = 0.0, sd_m: np.ndarray | None = None) -> print_map.PrintMap:
    """A board whose corners are A (2, 2) times the designed ones, turned and shifted."""
    flat = BOARD.square_m * BOARD.grid @ A.T
    turned = flat @ so3.exp(np.array([0, 0, 0.01]))[:2, :2].T + [0.002, -0.003]
    points = np.column_stack([turned, np.broadcast_to(height_m, len(turned))])
    return print_map.sheets_of(replace(BOARD, shape=BoardShape(points, None, sd_m)))[0]


def test_turn_and_shift_of_the_print_are_taken_out():
    sheet = printed(np.eye(2))
    np.testing.assert_allclose(sheet.offset_mm, 0, atol=1e-9)
    assert sheet.aspect_percent == pytest.approx(0, abs=1e-9) and sheet.shear_deg == pytest.approx(0, abs=1e-9)


def test_aspect_shear_and_single_corners_of_the_print():
    wide = printed(np.diag([1.01, 1.0]))
    assert wide.aspect_percent == pytest.approx(1.0)
    # from the middle of 8 squares of 60 mm: the outermost corner is 240 mm away, 1 % is 2.4 mm
    assert np.abs(wide.offset_mm[:, 0]).max() == pytest.approx(2.4, rel=1e-3)
    np.testing.assert_allclose(wide.local_mm, 0, atol=1e-9)
    sheared = printed(np.array([[1.0, np.tan(np.radians(0.2))], [0.0, 1.0]]))
    # the rows' axis leans by 0.2 degrees towards the columns' axis
    assert sheared.shear_deg == pytest.approx(0.2, rel=0.01)


def test_height_is_out_of_the_best_plane():
    x, y = (BOARD.square_m * BOARD.grid).T
    bow = 0.01 * (x - x.mean()) ** 2
    sheet = printed(np.eye(2), bow + 0.003 * x - 0.002 * y + 0.01)
    np.testing.assert_allclose(sheet.height_mm, 1e3 * (bow - bow.mean()), atol=1e-9)


@pytest.mark.parametrize(("sd_m", "determined"), [(1e-5, True), (1e-2, False)])
def test_a_face_that_was_not_seen_is_not_determined(sd_m, determined):
    sheet = printed(np.diag([1.01, 1.0]), 0.0, np.full((54, 3), sd_m))
    assert sheet.determined is determined and sheet.mean_sd_mm == pytest.approx((1e3 * sd_m, 1e3 * sd_m))


def test_arrows_of_the_print_lead_from_designed_to_true_corners():
    sheet = printed(np.diag([1.01, 1.0]))
    drawn, scale = print_map.figure(sheet, 60.0)
    dots, lines, tips = drawn["data"]
    np.testing.assert_allclose(np.array(tips["x"]) - dots["x"], scale * sheet.offset_mm[:, 0], atol=0.01)
    assert lines["x"][0] == dots["x"][0] and lines["x"][1] == pytest.approx(tips["x"][0], abs=0.01)

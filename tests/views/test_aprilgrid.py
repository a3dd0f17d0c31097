"""AprilGrids: detected in part and any way up, numbered as Kalibr prints them, and good for a rig."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from april_views import GRID, HEIGHT, WIDTH, photograph, plane_depth, pose, project

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import se3, so3
from rgbd_calib.io.board_files import read_board
from rgbd_calib.io.dataset import CameraInfo, write_dataset
from rgbd_calib.io.recording import save_color, save_depth
from rgbd_calib.io.rig import read_rig
from rgbd_calib.patterns import aprilgrid as printing
from rgbd_calib.types import APRILGRID_TAGS, Board
from rgbd_calib.views.detect import corner_depth, find_corners
from rgbd_calib.views.detect.aprilgrid import find_aprilgrid

# As in test_detect: two edges of 0.46 squares (13 px) each, contrast 150, noise 2, blur 0.65 px give 0.005 px; the drawing is
# exact to 1/4 px of the fine image's samples, 1/16 px at an edge, over 13 rows: 0.005 px. Twice that for the shared parameters.
SIGMA_PX = 2 * np.hypot(0.005, 0.005)


@pytest.mark.parametrize("roll_rad", [0.1, 1.7, 3.2, 4.6])
def test_corners_are_accurate_and_numbered_any_way_up(roll_rad):
    rng = np.random.default_rng(int(10 * roll_rad))
    T = pose(rng, GRID, roll_rad)
    ids, corners_px = find_corners(photograph(GRID, T, rng), GRID)
    assert len(ids) >= 0.9 * GRID.n_corners
    assert np.sqrt(np.mean((corners_px - project(GRID, T)[ids]) ** 2)) < SIGMA_PX


def test_a_board_that_is_seen_in_part():
    rng = np.random.default_rng(1)
    T = pose(rng, GRID, 0.2)
    gray = photograph(GRID, T, rng)
    gray[:, :320] = 120
    ids, corners_px = find_corners(gray, GRID)
    assert 20 <= len(ids) < 60
    assert np.sqrt(np.mean((corners_px - project(GRID, T)[ids]) ** 2)) < SIGMA_PX


def test_tags_with_a_border_of_one_cell_and_turned(monkeypatch):
    """As other programs print them."""
    tags = printing.tags

    def turned(board):
        for corner_m, cells in tags(board):
            yield corner_m, np.rot90(cells)

    monkeypatch.setattr(printing, "BORDER", 1)
    monkeypatch.setattr(printing, "tags", turned)
    rng = np.random.default_rng(2)
    T = pose(rng, GRID, 0.2)
    ids, corners_px = find_corners(photograph(GRID, T, rng), GRID)
    assert len(ids) > 0.8 * GRID.n_corners
    assert np.sqrt(np.mean((corners_px - project(GRID, T)[ids]) ** 2)) < 2 * SIGMA_PX  # less room beside the edges


def test_the_first_tag_is_at_the_bottom_left():
    rng = np.random.default_rng(3)
    T = pose(rng, GRID, 0.0)
    gray = photograph(GRID, T, rng)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = 2
    tags, numbers, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(gray)
    middles = {int(n): tag.reshape(4, 2).mean(axis=0) for n, tag in zip(numbers.ravel(), tags, strict=True)}
    assert middles[0][0] < middles[1][0] and middles[6][1] < middles[0][1]


def test_the_code_is_that_of_the_apriltag_library():
    """Tag 0 of 36h11 is 0xd5d628584, row by row from the top left, 1 is white."""
    board = Board(2, 2, 0.039, type="aprilgrid", marker_m=0.06, dictionary=APRILGRID_TAGS)
    ((_, cells),) = printing.tags(board)
    assert not cells[:2].any() and not cells[:, -2:].any() and cells.shape == (10, 10)
    assert int("".join("01"[int(white)] for white in cells[2:-2, 2:-2].ravel()), 2) == 0xD5D628584


def test_another_board_is_not_read():
    rng = np.random.default_rng(4)
    T = pose(rng, GRID, 0.2)
    other = replace(GRID, cols=8)
    assert find_aprilgrid(photograph(GRID, T, rng, printed=other), replace(GRID, cols=6)) is None
    assert find_corners(np.full((HEIGHT, WIDTH), 128, np.uint8), GRID) is None


def test_both_faces_coincide_through_the_board():
    board = replace(GRID, two_sided=True, thickness_m=0.005)
    front, back = board.corners_m(), board.corners_m(back=True)
    c, r = np.arange(board.n_corners) % board.cols, np.arange(board.n_corners) // board.cols
    np.testing.assert_allclose(back[r * board.cols + board.cols - 1 - c, :2], front[:, :2], atol=1e-12)
    T = board.T_face_board(back=True, turned=False)
    np.testing.assert_allclose(back @ T[:3, :3].T + T[:3, 3], front, atol=1e-12)
    np.testing.assert_allclose(np.diff(front[:4, 0]), [0.06, 0.018, 0.06], atol=1e-12)


def test_depth_of_each_corner_is_that_of_its_own_cell():
    rng = np.random.default_rng(5)
    T = pose(rng, GRID, 0.1)
    ids, corners_px = np.arange(GRID.n_corners), project(GRID, T)
    depth_m, pixels = corner_depth(plane_depth(T), GRID, ids, corners_px, rng)
    expected = (GRID.corners_m() @ T[:3, :3].T + T[:3, 3])[:, 2]
    np.testing.assert_allclose(depth_m, expected, atol=1e-6)
    inner = (ids % GRID.cols) % 11 * ((ids // GRID.cols) % 7) != 0  # cells of half a tag and half a gap to each side
    assert pixels[inner].min() > 0.7 * np.median(pixels[inner]) and pixels[inner].max() < 1.5 * np.median(pixels[inner])


def test_a_rig_from_a_board_that_both_cameras_see_in_part(run, tmp_path):
    rng = np.random.default_rng(6)
    T_1_2 = se3.make(so3.exp(np.array([0.0, -0.25, 0.0])), np.array([0.18, 0.01, 0.03]))
    (tmp_path / "april.yaml").write_text(
        "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 4\ntagSize: 0.06\ntagSpacing: 0.3\n"
    )
    board = read_board(tmp_path / "april.yaml")
    assert board.grid.shape == GRID.grid.shape and np.allclose(board.corners_m(), GRID.corners_m())
    for i in range(10):
        T_1 = pose(rng, GRID, rng.uniform(-3, 3), rng.uniform(0.6, 1.0))
        for camera, T in (("C1", T_1), ("C2", np.linalg.inv(T_1_2) @ T_1)):
            color = np.repeat(photograph(GRID, T, rng)[..., None], 3, axis=2)
            save_color(tmp_path / "in", camera, f"{i:03d}", color)
            raw = np.clip(1000 * plane_depth(T) + rng.normal(0, 1, (HEIGHT, WIDTH)), 0, 5000)
            save_depth(tmp_path / "in", camera, f"{i:03d}", raw.round().astype(np.uint16))
    write_dataset(tmp_path / "in", dict.fromkeys(("C1", "C2"), CameraInfo(WIDTH, HEIGHT, depth_stated=True)), board)
    outcome = run("calibrate", tmp_path / "in", "-o", tmp_path / "rig.yaml")
    assert outcome.status == 0, outcome.stderr
    rig = read_rig(tmp_path / "rig.yaml")
    found = rig.cameras["C2"].T_world_color
    sd = np.sqrt(np.diag(rig.cameras["C2"].covariance))
    off = se3.difference(found, T_1_2)
    assert np.all(np.abs(off) < 5 * sd), (off, sd)
    assert np.linalg.norm(sd[3:]) < 0.003


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("target_type: circlegrid\n", "target_type: 'circlegrid' seen, aprilgrid or checkerboard needed"),
        ("target_type: aprilgrid\ntagCols: 6\n", "tagRows: None seen, a whole number needed"),
        ("target_type: aprilgrid\ntagCols: 6.5\n", "tagCols: 6.5 seen, a whole number needed"),
        (
            "target_type: checkerboard\ntargetCols: 6\ntargetRows: 7\nrowSpacingMeters: 0.06\ncolSpacingMeters: 0.05\n",
            "0.05 x 0.06 m seen",
        ),
        ("cameras: {}\n", "a board was expected, 'cameras' was found"),
        ("board: {cols: 9, rows: 6}\n", r"line 1: board.square: .*required"),
        ("board: {type: aprilgrid, cols: 9, rows: 6, square: 0.04, marker: 0.06}\n", "two for each tag"),
        ("board: {type: aprilgrid, cols: 8, rows: 6, square: 0.04}\n", "needs 'marker'"),
    ],
)
def test_board_files_that_are_none(tmp_path, text, message):
    (tmp_path / "board.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_board(tmp_path / "board.yaml")


def test_boards_of_files(run, tmp_path):
    target = "target_type: checkerboard\ntargetCols: 9\ntargetRows: 6\nrowSpacingMeters: 0.06\ncolSpacingMeters: 0.06\n"
    (tmp_path / "board.yaml").write_text(target)
    assert read_board(tmp_path / "board.yaml") == Board(9, 6, 0.06)
    args = ("--type", "aprilgrid", "--cols", "12", "--rows", "8", "--square", "0.039")
    printed = run("board", *args, "-o", tmp_path / "board.pdf")
    assert printed.status == 0 and "tagSpacing" not in printed.stdout
    (tmp_path / "board.yaml").write_text(printed.stdout)
    assert read_board(tmp_path / "board.yaml") == GRID
    refused = run("init", tmp_path, "--board", tmp_path / "board.yaml", "--square", "0.06")
    assert refused.status == 2 and "the file describes the whole board" in refused.stderr


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--cols", "9", "--rows", "6"), "Take even numbers, such as 10 x 6"),
        (("--cols", "60", "--rows", "60"), "has 587 tags, 900 are needed"),
        (("--cols", "8", "--rows", "6", "--marker", "0.09"), "a tag's side between 0.04 and 0.08 m"),
        (("--cols", "8", "--rows", "6", "--dictionary", "DICT_5X5_50"), "one of DICT_APRILTAG_16H5"),
    ],
)
def test_boards_that_cannot_be_printed(run, tmp_path, args, message):
    outcome = run("board", "--type", "aprilgrid", "--square", "0.04", *args, "-o", tmp_path / "board.pdf")
    assert outcome.status == 2 and message in outcome.stderr

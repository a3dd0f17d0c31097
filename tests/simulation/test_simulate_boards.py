"""Simulated boards with markers: found where they truly are, whole and cut by the images' borders."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rgbd_calib.cli.options import progress
from rgbd_calib.geometry import se3
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_rig
from rgbd_calib.patterns import of_type
from rgbd_calib.simulation import board as boards
from rgbd_calib.simulation import rig as rigs
from rgbd_calib.simulation.bent import bent_faces
from rgbd_calib.simulation.color_sensor import ColorNoise, develop
from rgbd_calib.simulation.poses import close_poses, looks_at_back, shared_poses
from rgbd_calib.simulation.printed import printed
from rgbd_calib.simulation.realism import Realism
from rgbd_calib.simulation.recording import SimulationParams, simulate
from rgbd_calib.simulation.render import IdealImage, render_with_board
from rgbd_calib.simulation.room import furnished_room
from rgbd_calib.simulation.scene import Caster
from rgbd_calib.simulation.view import View
from rgbd_calib.types import Board
from rgbd_calib.views.detect import find_corners

BOARDS = [
    of_type(Board(6, 4, 0.085, True, 0.006), "charuco", dictionary="DICT_4X4_50"),
    of_type(Board(8, 6, 0.068, True, 0.006), "aprilgrid"),
]
SIGMA_PX = 0.03
"""Twice what is left of checkerboards, 0.014 px: the corners have half of their pixels, and far boards are small."""


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.type)
def test_corners_are_found_where_they_truly_are(board):
    rng, room = np.random.default_rng(0), Caster(furnished_room())
    made = printed(board, Realism(), rng)
    rig = rigs.true_rig(2, "arc", 640, 480, rng)
    view = View(rig.intrinsics["C1"], rig.T_room_color["C1"])
    grey = IdealImage(np.full((480, 640, 3), 0.2, np.float32), np.full((480, 640), 9.0), np.ones((480, 640)))
    errors_px, shares, faces, parts = [], [], set(), 0
    for T_room_board in [*shared_poses(rig, board, 6, room, rng), *close_poses(rig, board, "C1", 6, room, rng)]:
        T_color_board = se3.inverse(rig.T_room_color["C1"]) @ T_room_board
        back = bool(looks_at_back(T_color_board, board))
        true_px = view.intrinsics.project(se3.transform(T_color_board, made.board.corners_m(back)))
        inside = np.all((true_px > 8) & (true_px < [631, 471]), axis=1)  # the outermost have no room around them
        caster = Caster(boards.plate(board).moved(T_room_board))
        picture = render_with_board(view, grey, room, caster, rng, bent_faces(made, T_room_board, view.origin_m))
        ids, corners_px = find_corners(cv2.cvtColor(develop(picture, ColorNoise(), rng), cv2.COLOR_BGR2GRAY), board)
        errors_px.append(corners_px - true_px[ids])
        shares.append(len(np.intersect1d(ids, np.flatnonzero(inside))) / inside.sum())
        faces.add(back)
        parts += not inside.all()
    assert np.sqrt(np.mean(np.concatenate(errors_px) ** 2)) < SIGMA_PX
    assert np.abs(np.concatenate(errors_px)).max() < 8 * SIGMA_PX
    assert np.mean(shares) > 0.95 and min(shares) > 0.8
    assert faces == {False, True} and 3 <= parts < len(shares)


def test_a_recording_and_its_truth_have_the_board(tmp_path):
    board = BOARDS[1]
    params = SimulationParams(
        cameras=2, frames=1, intrinsic_views=0, distances_m=(), width=320, height=240, board=board, realism=Realism()
    )
    simulate(tmp_path, params, 1, progress)
    assert open_recording(tmp_path / "extrinsic").board == board
    assert read_rig(tmp_path / "truth.yaml").quality.board_shape.front_m.shape == (board.n_corners, 3)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--board-type", "aprilgrid"), "Take even numbers, such as 10 x 6"),
        (("--board-type", "charuco", "--marker", "0.06"), "less than the square of 0.06 m"),
        (("--board-type", "charuco", "--dictionary", "DICT_5X5_25"), "one of DICT_4X4_100"),
    ],
)
def test_boards_that_do_not_exist(run, tmp_path, args, message):
    outcome = run("simulate", tmp_path / "out", *args)
    assert outcome.status == 2 and message in outcome.stderr
    assert not (tmp_path / "out").exists()

"""The simulation: is what it draws and measures where its truth says?"""

from __future__ import annotations

import csv
import hashlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbd_calib.cli.options import progress
from rgbd_calib.geometry import camera, se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_boards, read_rig
from rgbd_calib.simulation import board as boards
from rgbd_calib.simulation import rig as rigs
from rgbd_calib.simulation.color_sensor import ColorNoise, develop
from rgbd_calib.simulation.depth_sensor import DepthNoise, biased, measure
from rgbd_calib.simulation.poses import close_poses, looks_at_back, shared_poses
from rgbd_calib.simulation.recording import SimulationParams, simulate
from rgbd_calib.simulation.render import IdealImage, render_with_board
from rgbd_calib.simulation.room import furnished_room
from rgbd_calib.simulation.scene import Caster, box
from rgbd_calib.simulation.textures import encode, linear, plain
from rgbd_calib.simulation.view import View
from rgbd_calib.simulation.wall import SQUARE, Wall, render_wall
from rgbd_calib.types import Board

BOARD = Board(9, 6, 0.060, two_sided=True, thickness_m=0.006)
LENS = Intrinsics(640, 480, 548.0, 551.0, 322.7, 236.4, (0.07, -0.14, 0.001, -0.0012, 0.0))
SMALL = SimulationParams(cameras=2, frames=2, intrinsic_views=1, distances_m=(1.0, 2.0), width=160, height=120, seed=5)


@pytest.fixture(scope="module")
def room() -> Caster:
    return Caster(furnished_room())


def grey_room(shape: tuple[int, int]) -> IdealImage:
    """Nothing but grey, 9 m away."""
    return IdealImage(np.full((*shape, 3), 0.2, np.float32), np.full(shape, 9.0), np.ones(shape))


def test_drawn_corners_are_where_the_projection_puts_them(room):
    rng = np.random.default_rng(0)
    rig = rigs.true_rig(2, "arc", 640, 480, rng)
    T_rooms = [*shared_poses(rig, BOARD, 6, room, rng), *close_poses(rig, BOARD, "C1", 6, room, rng)]
    view = View(rig.intrinsics["C1"], rig.T_room_color["C1"])
    errors_px = []
    for T_room_board in T_rooms:
        T_color_board = se3.inverse(rig.T_room_color["C1"]) @ T_room_board
        back = bool(looks_at_back(T_color_board, BOARD))
        true_px = camera.project(view.intrinsics.vector, se3.transform(T_color_board, BOARD.corners_m(back)))
        caster = Caster(boards.plate(BOARD).moved(T_room_board))
        picture = render_with_board(view, grey_room(view.shape), room, caster, rng)
        gray = cv2.cvtColor(develop(picture, ColorNoise(sigma_grey=0.0, vignette=0.0), rng), cv2.COLOR_BGR2GRAY)
        start = true_px[:, None].astype(np.float32)
        found = cv2.cornerSubPix(gray, start.copy(), (4, 4), (-1, -1), (3, 60, 1e-5)).reshape(-1, 2)
        errors_px.append(found - true_px)
    errors_px = np.concatenate(errors_px)
    # what is left is the sampling of the print (48 places a pixel) and 8-bit rounding, some 0.02 px a corner;
    # a picture shifted by a twentieth of a pixel, or half a pixel's mistake in a convention, is plain beside it
    assert np.all(np.abs(errors_px.mean(axis=0)) < 0.005)
    assert np.all(errors_px.std(axis=0) < 0.05)


def test_the_first_square_of_both_faces_is_black():
    for turned in (False, True):
        # straight ahead: the front's axes are the image's; a half turn about y shows the back
        R = np.diag([-1.0, 1.0, -1.0]) if turned else np.eye(3)
        T_color_board = se3.make(R, np.array([0.24 if turned else -0.24, -0.15, 1.0]))
        view = View(LENS, np.eye(4))
        caster = Caster(boards.plate(BOARD).moved(T_color_board))
        picture = render_with_board(view, grey_room(view.shape), caster, caster, np.random.default_rng(0))
        # half a square beyond corner (0, 0) of the face that is seen, both ways
        outside = se3.transform(T_color_board, BOARD.corners_m(back=turned)[:1]) - [0.03, 0.03, 0.0]
        u, v = np.round(camera.project(LENS.vector, outside)[0]).astype(int)
        right, _ = np.round(camera.project(LENS.vector, outside + [0.06, 0, 0])[0]).astype(int)
        assert picture.light[v, u].max() < 0.3 * picture.light[v, right].min()


def test_noise_of_a_wall_grows_with_the_square_of_the_distance():
    noise = DepthNoise()
    for middle_m in (0.8, 1.6, 3.2):
        # a little oblique, so that all phases of the steps of disparity and of the millimetres occur
        z_true_m = middle_m * np.broadcast_to(np.linspace(0.97, 1.03, 640), (480, 640))
        depth = measure(z_true_m, np.ones(z_true_m.shape), noise, rigs.no_depth_bias(), np.random.default_rng(1))
        k = np.std((depth / 1000.0 - z_true_m) / z_true_m**2)
        # 640 x 480 / (9 x 7) independent windows: 1 % of sigma; whole millimetres, 0.29 mm beside 1.02 mm at 0.8 m,
        # make 4 % there
        assert k == pytest.approx(noise.k_per_m, rel=0.06)


def test_noise_is_alike_within_the_matching_window_and_not_beyond():
    noise = DepthNoise(disparity_step_px=1e-6)
    z = measure(np.full((480, 640), 2.0), np.ones((480, 640)), noise, rigs.no_depth_bias(), np.random.default_rng(2))
    d = z - z.mean()
    r = [float(np.mean(d[:, :-lag] * d[:, lag:]) / d.var()) for lag in (3, 6, 12)]
    # a box of 9 px: 1 - lag / 9; 4877 windows make 0.014 of noise
    assert r == pytest.approx([6 / 9, 3 / 9, 0.0], abs=0.07)


def test_bias_is_what_the_rig_says():
    for seed in range(5):
        bias = rigs.true_depth_bias(np.random.default_rng(seed))
        z_true_m = np.linspace(0.5, 4.5, 50)
        np.testing.assert_allclose(bias.correct(biased(z_true_m, bias)), z_true_m, atol=1e-9)
        assert 0.009 < abs(float(bias.correct(np.array(3.0))) - 3.0) < 0.031


def test_wall_depths_give_the_bias_back():
    rng = np.random.default_rng(3)
    bias, noise, view = rigs.true_depth_bias(rng), DepthNoise(), View(LENS, np.eye(4))
    true_m = np.array([0.6, 0.9, 1.3, 1.8, 2.4, 3.0, 3.6])
    mean_m, se_m = [], []
    for distance_m in true_m:
        picture = render_wall(view, Wall(distance_m, SQUARE), rng)
        z_m = measure(picture.z_m, picture.cos_incidence, noise, bias, rng) / 1000.0
        mean_m.append(z_m[z_m > 0].mean())
        windows = z_m.size / np.prod(noise.window_px)
        # a wall that is square has one depth: its few steps of disparity are rounded to whole millimetres, 0.29 mm
        # each, of which three occur, however many pixels there are
        se_m.append(np.hypot(noise.k_per_m * distance_m**2 / np.sqrt(windows), 0.00029 / np.sqrt(3)))
    left_m = bias.correct(np.array(mean_m)) - true_m
    assert np.all(np.abs(left_m) < 4 * np.array(se_m))


def test_depth_has_holes_in_the_shadow_of_the_near_thing_only():
    z_m, cos = np.full((60, 640), 3.0), np.ones((60, 640))
    z_m[:, 280:440] = 1.0
    depth = measure(z_m, cos, DepthNoise(), rigs.no_depth_bias(), np.random.default_rng(4))
    # the shadow is the difference of disparities wide: 43.1 (1/1 - 1/3) = 28.7 px, left of the near thing
    assert np.all(depth[:, 253:280] == 0)
    assert np.all(depth[:, 5:247] > 0)
    assert np.all(depth[:, 286:434] > 0)
    assert np.all(depth[:, 446:] > 0)


def test_no_depth_at_grazing_angles_and_out_of_range():
    noise, bias = DepthNoise(), rigs.no_depth_bias()
    rng = np.random.default_rng(5)
    assert not measure(np.full((20, 20), 2.0), np.full((20, 20), 0.05), noise, bias, rng).any()
    assert not measure(np.full((20, 20), 0.2), np.ones((20, 20)), noise, bias, rng).any()
    assert not measure(np.full((20, 20), np.inf), np.ones((20, 20)), noise, bias, rng).any()


@pytest.mark.parametrize(("n", "layout"), [(2, "arc"), (2, "ring"), (4, "ring"), (8, "ring")])
def test_every_camera_shares_the_board_with_others(n, layout, room):
    rng = np.random.default_rng(6)
    rig = rigs.true_rig(n, layout, 640, 480, rng)
    seen = np.zeros((max(30, 8 * n), n), bool)
    for f, T_room_board in enumerate(shared_poses(rig, BOARD, len(seen), room, rng)):
        for k, c in enumerate(rig.cameras):
            T = se3.inverse(rig.T_room_color[c]) @ T_room_board
            p = se3.transform(T, BOARD.corners_m(bool(looks_at_back(T, BOARD))))
            px = camera.project(rig.intrinsics[c].vector, p)
            tilt = abs(p.mean(axis=0) @ T[:3, 2]) / np.linalg.norm(p.mean(axis=0))
            seen[f, k] = p[:, 2].min() > 0.3 and px.min() > 0 and np.all(px < [640, 480]) and tilt > 0.5
    assert np.all(seen.sum(axis=1) >= 2)
    assert np.all(seen.sum(axis=0) >= 8)


def test_srgb_curve_and_its_inverse():
    x = np.linspace(0, 1, 101)
    np.testing.assert_allclose(linear(encode(x)), x, atol=1e-7)  # the two pieces meet to 1e-8


def test_caster_gives_depth_along_rays_of_unit_z():
    caster = Caster(box([-1, -1, 2.0], [1, 1, 3.0], plain("box", "808080")))
    hits = caster.cast(np.zeros(3), np.array([[0.0, 0, 1], [0.3, 0.2, 1], [2.0, 0, 1]]))
    np.testing.assert_allclose(hits.t, [2.0, 2.0, np.inf], rtol=1e-12)


def digests(folder: Path) -> dict[str, str]:
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.rglob("*") if p.is_file()
    }


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("small")
    simulate(folder, SMALL, 1, progress)
    return folder


def test_every_byte_is_the_same_again_whatever_the_number_of_processes(small, tmp_path):
    simulate(tmp_path, SMALL, 2, progress)
    assert digests(tmp_path) == digests(small)


def test_recording_and_truth_agree(small):
    rig, boards_in_truth = read_rig(small / "truth.yaml"), read_boards(small / "truth.yaml")
    np.testing.assert_array_equal(rig.cameras["C1"].T_world_color, np.eye(4))
    for name in ("extrinsic", "intrinsic"):
        recording = open_recording(small / name)
        assert recording.board == BOARD
        assert set(recording.frames) <= set(boards_in_truth)
    walls = open_recording(small / "depth_bias")
    assert walls.distances_m("C1").keys() == walls.color_files["C1"].keys()
    with (small / "true_corners.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert {row["recording"] for row in rows} == {"extrinsic", "intrinsic"}
    for row in rows[:: len(rows) // 200]:
        seen_by = rig.cameras[row["camera"]]
        p_board = BOARD.corners_m(row["face"] == "back")[int(row["feature"])]
        T_color_board = se3.inverse(seen_by.T_world_color) @ boards_in_truth[row["frame"]]
        p = se3.transform(T_color_board, p_board)
        np.testing.assert_allclose([float(row[k]) for k in ("x_m", "y_m", "z_m")], p, atol=1e-6)
        px = camera.project(seen_by.intrinsics.vector, p)
        np.testing.assert_allclose([float(row["u_px"]), float(row["v_px"])], px, atol=2e-5)


def test_command_refuses_what_is_there_and_wrong_words(run, tmp_path):
    there = run("simulate", tmp_path)
    assert there.status == 2 and "exists already" in there.stderr
    for wrong in (("--board", "9by6"), ("--distances", "near,far"), ("--cameras", "1"), ("--layout", "heap")):
        outcome = run("simulate", tmp_path / "new", *wrong)
        assert outcome.status == 2 and wrong[0] in outcome.stderr
    assert list(tmp_path.iterdir()) == []


def test_board_that_no_camera_sees_whole_is_an_error_and_leaves_nothing(run, tmp_path):
    outcome = run("simulate", tmp_path / "new", "--square", "0.3", "--jobs", "1")
    assert outcome.status == 1
    assert "squares of 300 mm" in outcome.stderr
    assert list(tmp_path.iterdir()) == []


def test_depth_may_be_the_mean_of_several_readings(run, tmp_path):
    def wall_rms_m(name: str, *options: object) -> float:
        outcome = run(
            "simulate", tmp_path / name, "--cameras", 2, "--frames", 1, "--intrinsic-views", 0, "--distances", "2.5",
            "--width", 160, "--height", 120, "--ideal", "--no-bias", "--jobs", 1, *options,
        )  # fmt: skip
        assert outcome.status == 0, outcome.stderr
        recording = open_recording(tmp_path / name / "depth_bias")
        (frame,) = recording.color_files["C1"]
        return float(np.nanstd(recording.depth_m("C1", frame) - recording.distances_m("C1")[frame][0]))

    once, mean = wall_rms_m("once"), wall_rms_m("mean", "--depth-frames", 9)
    assert once == pytest.approx(1.6e-3 * 2.5**2, rel=0.1)
    assert mean == pytest.approx(once / 3, rel=0.15)
    refused = run("simulate", tmp_path / "new", "--wave", 5, "--depth-frames", 2)
    assert refused.status == 2 and "the board moves" in refused.stderr


def test_command_without_noise(run, tmp_path):
    outcome = run(
        "simulate", tmp_path / "new", "--cameras", 2, "--frames", 1, "--intrinsic-views", 0, "--distances", "1.5",
        "--width", 160, "--height", 120, "--no-noise", "--jobs", 1,
    )  # fmt: skip
    assert outcome.status == 0, outcome.stderr
    recording = open_recording(tmp_path / "new" / "depth_bias")
    (frame,) = recording.color_files["C1"]
    # whole millimetres of depth
    np.testing.assert_allclose(recording.depth_m("C1", frame), recording.distances_m("C1")[frame][0], atol=0.00051)

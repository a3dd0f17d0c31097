"""The simulated carried board: its motion, its clocks, its corners and its images, against their truth."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_boards, read_rig
from rgbd_calib.io.tables import read_table
from rgbd_calib.pipeline.evaluate import evaluate_truth
from rgbd_calib.simulation.carried import BoardExposure, render_carried
from rgbd_calib.simulation.clocks import CameraClock, WaveParams, draw_clocks, expose
from rgbd_calib.simulation.color_sensor import ColorNoise, develop
from rgbd_calib.simulation.motion import hand_motion
from rgbd_calib.simulation.render import IdealImage
from rgbd_calib.simulation.rig import look_at
from rgbd_calib.simulation.room import furnished_room
from rgbd_calib.simulation.scene import Caster
from rgbd_calib.simulation.session import draw_scene
from rgbd_calib.simulation.wave import film_wave
from rgbd_calib.types import Board, Clock

BOARD = Board(9, 6, 0.060, two_sided=True, thickness_m=0.006)


def test_the_motion_is_band_limited_and_has_stops():
    rng = np.random.default_rng(2)
    scene = draw_scene(2, "arc", 0, 0, rng)
    motion = hand_motion([own.T_world_color for own in scene.rig.cameras.values()], BOARD, 40.0, rng)
    t = np.arange(0, 40, 0.02)
    poses = motion.poses(t)
    velocity = np.diff(poses[:, :3, 3], axis=0) / 0.02
    spectrum = np.abs(np.fft.rfft(velocity * np.hanning(len(velocity))[:, None], axis=0)) ** 2
    above = np.fft.rfftfreq(len(velocity), 0.02) > 8.0
    assert spectrum[above].sum() < 1e-4 * spectrum.sum()
    speed = np.convolve(np.linalg.norm(velocity, axis=1), np.ones(15) / 15, "valid")  # over the bounce of steps
    assert speed.min() < 0.12 < 0.3 < np.median(speed) < speed.max() < 1.5


@pytest.mark.parametrize("seed", range(4))
def test_the_board_goes_near_and_far_and_into_the_corners(seed):
    """As the guide asks of people: within 30 s over 1.3 m of distance and more than half of each image's 8 x 6 cells."""
    rng = np.random.default_rng(seed)
    session = film_wave(draw_scene(2, "arc", 0, 0, rng), WaveParams(seconds=30, rate_hz=5), rng)
    for name, own in session.truth.cameras.items():
        views = [view for view in session.views if view.camera == name]
        z = np.concatenate([view.depth_m for view in views])
        px = np.concatenate([view.corners_px for view in views])
        K = own.intrinsics
        cells = np.histogram2d(*px.T, bins=(8, 6), range=((0, K.width), (0, K.height)))[0]
        assert np.nanmax(z) - np.nanmin(z) > 1.3
        assert (cells > 0).sum() > cells.size / 2


@pytest.mark.parametrize("kind", ["still", "line"])
def test_degenerate_motions(kind):
    rng = np.random.default_rng(0)
    scene = draw_scene(2, "arc", 0, 0, rng)
    motion = hand_motion([own.T_world_color for own in scene.rig.cameras.values()], BOARD, 5.0, rng, kind)
    poses = motion.poses(np.linspace(0, 5, 50))
    np.testing.assert_allclose(poses[:, :3, :3], np.broadcast_to(poses[0, :3, :3], (50, 3, 3)), atol=1e-12)
    assert np.linalg.matrix_rank(poses[:, :3, 3] - poses[0, :3, 3], tol=1e-9) == (0 if kind == "still" else 1)


def test_stamps_lead_back_to_the_true_times():
    params = WaveParams(seconds=20, offset_s=90.0, drift_ppm=100.0, lost=0.1)
    rng = np.random.default_rng(1)
    clocks = draw_clocks(["C1", "C2"], params, rng)
    for name, clock in clocks.items():
        taken = expose(clock, params, rng)
        stamp_s = 1e-6 * taken.stamps_us
        t = stamp_s + clock.offset_s + 1e-6 * clock.drift_ppm * (stamp_s - stamp_s[0])
        np.testing.assert_allclose(t, taken.t_s, atol=2e-7)
        assert 0.85 < len(taken.stems) / (20 * 30) < 0.95
        assert (clock.offset_s == 0.0) == (name == "C1")


def test_corners_are_those_of_the_pose_at_the_row_that_shows_them():
    rng = np.random.default_rng(3)
    scene = draw_scene(2, "arc", 0, 0, rng)
    params = WaveParams(seconds=3, readout_s=0.02)
    session = film_wave(scene, params, rng)
    assert len(session.views) > 120
    left = []
    for view in session.views[::10]:
        own, clock = session.truth.cameras[view.camera], session.clocks[view.camera]
        rows = (view.corners_px[:, 1] + 0.5) / own.intrinsics.height - 0.5
        T = se3.inverse(own.T_world_color) @ session.motion.poses(
            session.t_s[view.camera][view.frame] + clock.readout_s * rows
        )
        p = se3.transform(T, session.board.corners_m(T[0, :3, 2] @ T[0, :3, 3] < 0))
        left.append(own.intrinsics.project(p) - view.corners_px)
    rms = np.sqrt(np.mean(np.square(left)))
    assert 0.5 < rms / scene.noise.sigma_2d_px < 2.0  # the noise, more where it is blurred
    assert np.abs(np.mean(left)) < 0.02


@pytest.mark.parametrize("readout_s", [0.0, 0.02])
def test_images_show_the_corners_of_their_rows(readout_s):
    rng = np.random.default_rng(4)
    K = Intrinsics(640, 480, 548.0, 551.0, 322.7, 236.4, (0.07, -0.14, 0.001, -0.0012, 0.0))
    T_room_color = look_at(np.array([0.0, -2.0, 1.5]), np.array([0.0, 0.0, 1.2]))
    motion = hand_motion([T_room_color], BOARD, 4.0, rng)
    clock = CameraClock(0.0, 1 / 30, 0.0, 0.0, 0.005, readout_s, 0.0)
    room = IdealImage(np.full((480, 640, 3), 0.2, np.float32), np.full((480, 640), 9.0), np.ones((480, 640)))
    shift, still = [], []
    for t in (0.7, 1.9, 3.1):
        carried = BoardExposure(motion, np.eye(4), t, clock, 0.006)
        picture = render_carried(carried, K, T_room_color, room, Caster(furnished_room()), BOARD, None, rng)
        gray = cv2.cvtColor(develop(picture, ColorNoise(sigma_grey=0.0, vignette=0.0), rng), cv2.COLOR_BGR2GRAY)
        T = se3.inverse(T_room_color) @ carried.pose()
        corners = BOARD.corners_m(T[:3, 2] @ T[:3, 3] < 0)
        true_px = K.project(carried.points(K, T_room_color, corners))
        term = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
        found = cv2.cornerSubPix(gray, true_px[:, None].astype(np.float32), (4, 4), (-1, -1), term)[:, 0]
        shift.append(found - true_px)
        still.append(true_px - K.project(se3.transform(T, corners)))
    assert np.abs(np.mean(shift, axis=(0, 1))).max() < 0.04
    assert np.sqrt(np.mean(np.square(shift))) < 0.12
    moved = np.sqrt(np.mean(np.square(still)))
    assert moved > 0.05 if readout_s else moved < 1e-9


def test_command_writes_each_camera_with_its_own_frames_and_clock(run, tmp_path):
    options = [
        "--wave",
        "1",
        "--rate",
        "4",
        "--cameras",
        "2",
        "--width",
        "160",
        "--height",
        "120",
        "--intrinsic-views",
        "0",
        "--jobs",
        "1",
        "--seed",
        "5",
    ]
    outcome = run("simulate", tmp_path / "out", *options, "--distances", "")
    assert outcome.status == 0, outcome
    recording = open_recording(tmp_path / "out" / "wave")
    assert not recording.synchronous
    clocks = {c: own.clock for c, own in read_rig(tmp_path / "out" / "truth.yaml").cameras.items()}
    assert isinstance(clocks["C2"], Clock) and clocks["C1"].offset_s == 0.0
    times = [
        row
        for _, row in read_table(
            tmp_path / "out" / "true_times.csv", ("camera", "frame", "t_s", "tx_m", "ty_m", "tz_m")
        )
    ]
    for c in ("C1", "C2"):
        stamps = recording.timestamps_us(c)
        assert set(stamps) == set(recording.color_files[c]) == set(recording.depth_files[c])
        true_s = {row["frame"]: float(row["t_s"]) for row in times if row["camera"] == c}
        first = next(iter(stamps.values()))[0]
        for frame, (color_us, _) in stamps.items():
            t = 1e-6 * color_us + clocks[c].offset_s + 1e-12 * clocks[c].drift_ppm * (color_us - first)
            assert t == pytest.approx(true_s[frame], abs=1e-6)
    boards, corners = read_boards(tmp_path / "out" / "truth.yaml"), tmp_path / "out" / "true_corners.csv"
    hidden: dict[str, bool] = {}
    for _, row in read_table(corners, ("camera", "frame", "visible")):
        name = f"{row['camera']} {row['frame']}"
        hidden[name] = hidden.get(name, False) or row["visible"] != "1"
    assert boards and set(boards) <= {name for name, some in hidden.items() if not some}
    own = next(row for row in times if f"{row['camera']} {row['frame']}" in boards)
    place = [float(own[key]) for key in ("tx_m", "ty_m", "tz_m")]
    np.testing.assert_allclose(boards[f"{own['camera']} {own['frame']}"][:3, 3], place, atol=1e-6)
    points = evaluate_truth(tmp_path / "out" / "truth.yaml", tmp_path / "out" / "truth.yaml").all
    assert points.mean_mm < 1e-6

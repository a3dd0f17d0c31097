"""The errors of real prints, sensors and walls: as large as they are said to be, and where the truth says."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from rgbd_calib.cli.options import progress
from rgbd_calib.geometry import se3
from rgbd_calib.io.files import load_yaml
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_boards, read_rig
from rgbd_calib.simulation import board as boards
from rgbd_calib.simulation import rig as rigs
from rgbd_calib.simulation.bent import bent_faces
from rgbd_calib.simulation.color_sensor import ColorNoise, develop
from rgbd_calib.simulation.depth_field import reported, structured_light
from rgbd_calib.simulation.depth_sensor import DepthNoise, measure
from rgbd_calib.simulation.poses import close_poses, looks_at_back, shared_poses
from rgbd_calib.simulation.printed import printed
from rgbd_calib.simulation.realism import IDEAL, Realism
from rgbd_calib.simulation.recording import SimulationParams, simulate
from rgbd_calib.simulation.render import IdealImage, render_with_board
from rgbd_calib.simulation.room import furnished_room
from rgbd_calib.simulation.scene import Caster
from rgbd_calib.simulation.session import draw_scene, film
from rgbd_calib.simulation.view import View
from rgbd_calib.types import Board

BOARD = Board(9, 6, 0.060, two_sided=True, thickness_m=0.006)
PRINT_ONLY = Realism().without("depth_field", "registration", "walls")
SMALL = SimulationParams(
    cameras=2, frames=2, intrinsic_views=1, distances_m=(1.0, 2.0), width=320, height=240, seed=5,
    depth_noise=DepthNoise(k_per_m=1e-5, disparity_step_px=1e-4), realism=Realism(),
)  # fmt: skip


@pytest.fixture(scope="module")
def room() -> Caster:
    return Caster(furnished_room())


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp("realistic")
    simulate(folder, SMALL, 1, progress)
    return folder


def affine_part(shape_m):
    """A (2, 2) and the offsets (n, 2) besides it, of corners (n, 3) against those of a flat board."""
    flat = BOARD.corners_m()[:, :2]
    V = np.column_stack([flat - flat.mean(axis=0), np.ones(len(flat))])
    straight = np.linalg.lstsq(V, shape_m[:, :2], rcond=None)[0]
    return straight[:2].T, shape_m[:, :2] - V @ straight


def aspect_and_shear(A):
    columns, rows = A[:, 0], A[:, 1]
    angle = np.arccos(columns @ rows / np.linalg.norm(columns) / np.linalg.norm(rows))
    return np.log(np.linalg.norm(columns) / np.linalg.norm(rows)), np.pi / 2 - angle


def test_prints_scatter_as_they_should():
    sizes = Realism()
    shapes = [printed(BOARD, sizes, np.random.default_rng(seed)).board.shape for seed in range(300)]
    fronts = [affine_part(s.front_m) for s in shapes]
    behind = [affine_part(s.back_m) for s in shapes]
    aspect, shear = np.array([aspect_and_shear(A) for A, _ in fronts]).T
    # deviations of 300 draws: 4 % each
    assert np.std(aspect) == pytest.approx(sizes.print_aspect, rel=0.17)
    assert np.std(shear) == pytest.approx(sizes.print_shear_rad, rel=0.17)
    assert [np.linalg.det(A) for A, _ in fronts] == pytest.approx(np.ones(300), abs=1e-5)  # but for the bow's slope
    offsets = np.stack([d for _, d in fronts])
    assert np.sqrt(np.mean(offsets**2, axis=(1, 2))) == pytest.approx(np.full(300, sizes.print_offset_m), rel=0.02)
    back_aspect, back_shear = np.array([aspect_and_shear(A) for A, _ in behind]).T
    np.testing.assert_allclose(back_aspect, aspect, atol=1e-5)
    np.testing.assert_allclose(back_shear, -shear, atol=1e-5)
    beside = np.array([(s.back_m - s.front_m)[:, :2].mean(axis=0) for s in shapes])
    assert np.std(beside) == pytest.approx(sizes.back_shift_m, rel=0.12)
    turns = [np.arctan2(B[1, 0] - B[0, 1], B.trace()) - np.arctan2(A[1, 0] - A[0, 1], A.trace())
             for (A, _), (B, _) in zip(fronts, behind, strict=True)]  # fmt: skip
    assert np.std(turns) == pytest.approx(sizes.back_turn_rad, rel=0.17)
    assert np.allclose([np.mean((s.back_m - s.front_m)[:, 2]) for s in shapes], BOARD.thickness_m, atol=2e-5)


def test_offsets_of_corners_are_smooth_and_not_white():
    like = []
    for seed in range(50):
        d = affine_part(printed(BOARD, Realism(), np.random.default_rng(seed)).board.shape.front_m)[1]
        grid = d.reshape(6, 9, 2)
        like.append((grid[:, 1:] * grid[:, :-1]).mean() / np.mean(d**2))
    assert np.mean(like) > 0.6  # neighbours along a row; white offsets, their affine part apart, have about -0.05


def test_a_board_with_nothing_wrong_is_flat():
    shape = printed(BOARD, IDEAL, np.random.default_rng(0)).board.shape
    np.testing.assert_allclose(shape.front_m, BOARD.corners_m(), atol=1e-12)
    flat = replace(BOARD, shape=shape)
    np.testing.assert_allclose(flat.corners_m(back=True), BOARD.corners_m(back=True), atol=1e-12)


@pytest.mark.parametrize("exaggerated", [1, 4])
def test_drawn_corners_are_where_the_shape_and_the_projection_put_them(room, exaggerated):
    rng = np.random.default_rng(0)
    sizes = {k: exaggerated * v for k, v in vars(PRINT_ONLY).items()}
    made = printed(BOARD, Realism(**sizes), rng)
    rig = rigs.true_rig(2, "arc", 640, 480, rng)
    T_rooms = [*shared_poses(rig, BOARD, 6, room, rng), *close_poses(rig, BOARD, "C1", 6, room, rng)]
    view = View(rig.intrinsics["C1"], rig.T_room_color["C1"])
    nothing = IdealImage(np.full((480, 640, 3), 0.2, np.float32), np.full((480, 640), 9.0), np.ones((480, 640)))
    errors_px, moved_px, depth_m = [], [], []
    for T_room_board in T_rooms:
        T_color_board = se3.inverse(rig.T_room_color["C1"]) @ T_room_board
        back = bool(looks_at_back(T_color_board, BOARD))
        corners = se3.transform(T_color_board, made.board.corners_m(back))
        true_px = view.intrinsics.project(corners)
        caster = Caster(boards.plate(BOARD).moved(T_room_board))
        bent = bent_faces(made, T_room_board, view.origin_m)
        picture = render_with_board(view, nothing, room, caster, rng, bent)
        gray = cv2.cvtColor(develop(picture, ColorNoise(sigma_grey=0.0, vignette=0.0), rng), cv2.COLOR_BGR2GRAY)
        start = true_px[:, None].astype(np.float32)
        found = cv2.cornerSubPix(gray, start.copy(), (4, 4), (-1, -1), (3, 60, 1e-5)).reshape(-1, 2)
        errors_px.append(found - true_px)
        flat_px = view.intrinsics.project(se3.transform(T_color_board, BOARD.corners_m(back)))
        moved_px.append(true_px - flat_px)
        # depth at the middles of pixels is carried along the board's plane to the corner
        u, v = np.round(true_px).astype(int).T
        normal = T_color_board[:3, 2]
        ray, there = view.intrinsics.rays(np.stack([u, v], axis=1).astype(float)), view.intrinsics.rays(true_px)
        depth_m.append(picture.z_m[v, u] * (ray @ normal) / (there @ normal) - corners[:, 2])
    errors_px, moved_px = np.concatenate(errors_px), np.concatenate(moved_px)
    assert moved_px.std(axis=0).max() > 0.08 * exaggerated
    # as for a flat board: some 0.02 px a corner from sampling, 8 bits and the finder
    assert np.all(np.abs(errors_px.mean(axis=0)) < 0.005)
    assert np.all(errors_px.std(axis=0) < 0.05)
    # the face's slope against the plate, 8 mrad a mm of bow, over half a pixel of 2 mm
    assert np.abs(np.concatenate(depth_m)).max() < 2e-5 * exaggerated + 1e-5


def test_depth_is_noisier_on_oblique_surfaces():
    full, sigmas_m = np.ones((240, 320)), []
    noise = DepthNoise(disparity_step_px=1e-6, oblique_m=1e-4)
    for degrees in (0.0, 70.0):
        cos = np.cos(np.radians(degrees)) * full
        depth = measure(full, cos, noise, rigs.no_depth_bias(), np.random.default_rng(0))
        sigmas_m.append(depth[depth > 0].std() / 1000)
    # at 70 degrees 12.25 times 0.1 mm beside 1.6 mm, and 0.29 mm of rounding
    assert sigmas_m == pytest.approx([0.00163, 0.00204], rel=0.06)


def test_fields_have_the_size_that_is_asked_for_and_are_what_their_grid_says():
    pixels = np.stack(np.meshgrid(np.arange(0, 640, 7.0), np.arange(0, 480, 7.0)), axis=-1)
    ranges, rms = np.linspace(0.8, 3.0, 12), []
    for seed in range(30):
        field = structured_light(640, 480, 0.009, np.random.default_rng(seed))
        errors = [field.grid.error_m(pixels, np.full(pixels.shape[:2], z)) for z in ranges]
        rms.append(np.sqrt(np.mean(np.square(errors))))
        for z, own in zip(ranges, errors, strict=True):
            np.testing.assert_allclose(field.error_m(np.full((480, 640), z))[::7, ::7], own, atol=1e-6)
    assert np.exp(np.mean(np.log(rms))) == pytest.approx(0.009, rel=0.15)  # 30 draws of a fifth: 4 %
    # some mm at 1 m, and more than 6 times that at 3 m
    assert np.std(errors[-1]) > 6 * np.std(structured_light(640, 480, 0.009, np.random.default_rng(29)).error_m(
        np.full((480, 640), 1.0)))  # fmt: skip


def test_a_field_and_a_bias_are_taken_off_again():
    rng = np.random.default_rng(1)
    field, bias = structured_light(640, 480, 0.02, rng), rigs.true_depth_bias(rng)
    z_true_m = np.broadcast_to(np.linspace(0.6, 4.0, 640), (480, 640))
    z_m = reported(z_true_m, bias, field)
    np.testing.assert_allclose(bias.correct(z_m) + field.error_m(z_m), z_true_m, atol=1e-6)


def test_depth_images_are_what_the_true_sensor_reports(small):
    rig, T_world_board = read_rig(small / "truth.yaml"), read_boards(small / "truth.yaml")
    shape = rig.quality.board_shape
    recording, seen = open_recording(small / "extrinsic"), 0
    for name, own in rig.cameras.items():
        sensor = own.depth_sensor
        for frame in recording.frames:
            T_color_board = se3.inverse(own.T_world_color) @ T_world_board[frame]
            back = bool(looks_at_back(T_color_board, BOARD))
            corners = replace(BOARD, shape=shape).corners_m(back)
            pixels, reported_m = sensor.report(se3.transform(T_color_board, corners))
            at = np.round(pixels).astype(int)
            if not np.all((at > 1) & (at < [318, 238])):
                continue
            z_m = recording.depth_m(name, frame)[at[:, 1], at[:, 0]]
            on_board = se3.transform(se3.inverse(T_color_board), sensor.points(at.astype(float), z_m))
            off = on_board[:, 2] - corners[:, 2]
            # whole millimetres, 0.29 mm, and the board's slope within a pixel is on the board
            assert np.nanstd(off) < 0.0005 and abs(np.nanmean(off)) < 0.0002
            assert np.abs(reported_m - z_m).max() < 0.02
            seen += 1
    assert seen >= 3


def test_walls_are_planes_where_the_truth_says_and_distances_are_taped(small):
    rig, recording = read_rig(small / "truth.yaml"), open_recording(small / "depth_bias")
    v, u = np.mgrid[:240:6, :320:6]
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2).astype(float)
    for name, own in rig.cameras.items():
        written = recording.distances_m(name)
        for frame, wall in rig.quality.walls[name].items():
            normal = wall.normal
            assert np.arccos(normal[2]) <= np.radians(2.0)
            z_m = recording.depth_m(name, frame)[v, u].ravel()
            off = own.depth_sensor.points(pixels, z_m) @ normal - normal[2] * wall.distance_m
            assert np.nanstd(off) < 0.0005 and abs(np.nanmean(off)) < 0.0002
            assert 0 < abs(written[frame][0] - wall.distance_m) < 5 * np.hypot(0.002, 0.0015)
    text = (small / "depth_bias" / "C1" / "distances.csv").read_text().splitlines()
    assert text[0] == "frame,distance_m,sd_m" and text[1].endswith(",0.002")


def test_datasets_do_not_give_the_truth_away(small):
    assert open_recording(small / "extrinsic").board == BOARD
    text = (small / "extrinsic" / "dataset.yaml").read_text()
    assert "shape" not in text
    assert load_yaml(small / "truth.yaml")["provenance"]["simulated"]["realism"]["field_m"] == 0.009


def test_poses_and_lenses_do_not_depend_on_what_else_is_wrong(small, tmp_path):
    simulate(tmp_path, replace(SMALL, realism=IDEAL), 1, progress)
    real, ideal = read_rig(small / "truth.yaml"), read_rig(tmp_path / "truth.yaml")
    for name, own in ideal.cameras.items():
        assert real.cameras[name].intrinsics == own.intrinsics
        np.testing.assert_array_equal(real.cameras[name].T_world_color, own.T_world_color)
    there, here = read_boards(small / "truth.yaml"), read_boards(tmp_path / "truth.yaml")
    assert all(np.array_equal(there[f], here[f]) for f in here)


def test_parts_are_switched_one_by_one():
    for part, kept in (("print", "field_m"), ("depth_field", "print_aspect"), ("walls", "registration_px")):
        sizes = Realism().without(part)
        assert not sizes.has(part)
        assert getattr(sizes, kept) == getattr(Realism(), kept)
    assert not any(vars(IDEAL).values())


def test_sessions_of_corners_have_the_same_errors():
    scene = draw_scene(2, "arc", 6, 3, np.random.default_rng(3), realism=Realism())
    quiet = replace(scene, noise=replace(scene.noise, sigma_2d_px=0.0, k_depth_per_m=0.0, k_plane_per_m=0.0))
    session = film(quiet, np.random.default_rng(0))
    assert session.board == BOARD
    for view in session.views:
        own = session.truth.cameras[view.camera]
        T_color_board = se3.inverse(own.T_world_color) @ session.boards[view.frame]
        back = bool(looks_at_back(T_color_board, BOARD))
        corners = scene.board.corners_m(back)
        np.testing.assert_allclose(
            own.intrinsics.project(se3.transform(T_color_board, corners)), view.corners_px, atol=1e-9
        )
        # depth beside the colour image is that of another place on the board
        p = se3.transform(se3.inverse(T_color_board), own.depth_sensor.points(view.corners_px, view.depth_m))
        np.testing.assert_allclose(p[:, 2], corners[:, 2], atol=1e-4)  # the shape's slope, over some mm
        assert np.linalg.norm(p - corners, axis=1).mean() > 1e-3
    assert session.walls is not None and session.wall_cells is not None
    for name, cells in session.wall_cells.items():
        assert cells.shape == (10, 1200, 3)
        errors = session.walls[name][:, 1] - np.array([0.6, 0.9, 1.2, 1.5, 1.8, 2.2, 2.6, 3.0, 3.5, 4.0])
        assert 0 < np.abs(errors).max() < 0.01

"""Depth cameras of their own, time of flight, stereo, infrared images, and what colour cameras make of the light."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from rgbd_calib.cli.options import progress
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import LENS_KINDS, Intrinsics, fold_radius
from rgbd_calib.io.files import load_yaml
from rgbd_calib.io.rig import read_boards, read_rig
from rgbd_calib.io.schema_parts import DepthCameraModel
from rgbd_calib.simulation.color_sensor import ColorNoise, Optics, develop
from rgbd_calib.simulation.depth_field import reported, stereo
from rgbd_calib.simulation.depth_sensor import STEREO
from rgbd_calib.simulation.lenses import DEPTH_SIZES, color_lens, depth_camera
from rgbd_calib.simulation.poses import looks_at_back
from rgbd_calib.simulation.realism import IDEAL, Realism
from rgbd_calib.simulation.recording import SimulationParams, simulate
from rgbd_calib.simulation.render import IdealImage
from rgbd_calib.simulation.rig import no_depth_bias, true_depth_bias, true_intrinsics
from rgbd_calib.simulation.time_of_flight import (
    TimeOfFlight,
    amplitude,
    measure_time_of_flight,
    nodes_px,
    time_of_flight_field,
)
from rgbd_calib.types import Board

BOARD = Board(9, 6, 0.060, two_sided=True, thickness_m=0.006)
DEPTH_LENS = Intrinsics(512, 424, 365.0, 365.0, 255.5, 211.5, (0.09, -0.27, 0.0, 0.0, 0.095))
QUIET = TimeOfFlight(k_m=1e-6)
KINECTS = SimulationParams(
    cameras=2, frames=3, intrinsic_views=1, distances_m=(1.2,), seed=2, sensor="tof", depth_noise=TimeOfFlight(k_m=1e-5),
    lenses=("rational", "fisheye"), depth_size=(512, 424), infrared=True, realism=Realism().without("multipath"),
)  # fmt: skip


@pytest.fixture(scope="module")
def kinects(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kinects")
    simulate(folder, KINECTS, 1, progress)
    return folder


def ray_lengths(lens=DEPTH_LENS):
    v, u = np.mgrid[: lens.height, : lens.width].astype(float)
    return np.linalg.norm(lens.rays(np.stack([u, v], axis=-1)), axis=-1)


@pytest.mark.parametrize("kind", LENS_KINDS)
def test_lenses_can_be_inverted_all_over_the_image(kind):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        lens = color_lens(kind, true_intrinsics(640, 480, rng), rng)
        border = np.array([[-0.5, -0.5], [639.5, -0.5], [-0.5, 479.5], [639.5, 479.5]])
        rays = lens.rays(border)
        np.testing.assert_allclose(lens.project(rays), border, atol=1e-9)
        assert np.linalg.norm(rays[:, :2], axis=1).max() < fold_radius(lens.distortion, lens.model)


@pytest.mark.parametrize("size", DEPTH_SIZES)
def test_depth_cameras_stand_beside_the_colour_camera(size):
    places = []
    for seed in range(20):
        own = depth_camera(size, np.random.default_rng(seed))
        assert (own.intrinsics.width, own.intrinsics.height) == size
        assert np.isfinite(own.intrinsics.rays(np.array([[-0.5, -0.5], [size[0] - 0.5, size[1] - 0.5]]))).all()
        places.append(own.T_color_depth[:3, 3])
    assert np.linalg.norm(np.mean(places, axis=0) - [0.052, 0, 0]) < 0.002


def test_unregistered_depth_and_infrared_are_what_the_true_camera_sees(kinects):
    rig, T_world_board = read_rig(kinects / "truth.yaml"), read_boards(kinects / "truth.yaml")
    assert [len(own.intrinsics.distortion) for own in rig.cameras.values()] == [8, 4]
    shape = rig.quality.board_shape
    errors_px, seen = [], 0
    for name, own in rig.cameras.items():
        sensor = own.depth_sensor
        for path in sorted(kinects.glob(f"*trinsic/{name}/depth/*.png")):
            T_color_board = se3.inverse(own.T_world_color) @ T_world_board[path.stem]
            back = bool(looks_at_back(T_color_board, BOARD))
            corners = replace(BOARD, shape=shape).corners_m(back)
            pixels, _ = sensor.report(se3.transform(T_color_board, corners))
            if not np.all((pixels > 4) & (pixels < [507, 419])):
                continue
            depth_raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            assert depth_raw.shape == (424, 512) and depth_raw.dtype == np.uint16
            u, v = np.round(pixels).astype(int).T
            p = sensor.points(np.stack([u, v], axis=1).astype(float), depth_raw[v, u] / 1000)
            # the drift is along the ray
            eye = sensor.camera.T_color_depth[:3, 3]
            drift_m = rig.quality.depth_drift[name][path.stem]
            p -= (p - eye) * drift_m / np.linalg.norm(p - eye, axis=1, keepdims=True)
            # millimetres are rounded, 0.29 mm along the ray, and the plate is bent by a mm over half a metre
            off_m = se3.transform(se3.inverse(T_color_board), p)[:, 2] - corners[:, 2]
            assert off_m.std() < 0.0006 and abs(off_m.mean()) < 0.0003
            infrared = cv2.imread(str(path).replace("depth", "ir"), cv2.IMREAD_UNCHANGED)
            assert infrared.shape == (424, 512) and infrared.dtype == np.uint16
            grey = np.clip(infrared / np.quantile(infrared, 0.98) * 220, 0, 255).astype(np.uint8)
            start = pixels[:, None].astype(np.float32)
            found = cv2.cornerSubPix(grey, start.copy(), (3, 3), (-1, -1), (3, 60, 1e-5)).reshape(-1, 2)
            errors_px.append(found - pixels)
            seen += 1
    assert seen >= 4
    # squares of 7 to 20 px, a finder of 7 x 7 px: 0.1 px a corner, and a mean over 54 of them in each view
    assert np.abs(np.concatenate(errors_px).mean(axis=0)).max() < 0.015
    assert np.concatenate(errors_px).std() < 0.12


def test_datasets_state_the_factorys_idea_of_the_depth_camera(kinects):
    rig, data = read_rig(kinects / "truth.yaml"), load_yaml(kinects / "extrinsic" / "dataset.yaml")
    assert data["depth_registered"] is False
    for name, entry in data["cameras"].items():
        stated, true = DepthCameraModel.model_validate(entry["depth"]).value(), rig.cameras[name].depth_camera
        assert stated is not None and true is not None
        assert 0 < abs(stated.intrinsics.fx / true.intrinsics.fx - 1) < 0.015
        assert 0 < np.linalg.norm((stated.T_color_depth - true.T_color_depth)[:3, 3]) < 0.01
    assert {f"{p.parents[1].name}" for p in kinects.glob("extrinsic/*/ir/*.png")} == {"C1", "C2"}


def test_depth_drifts_towards_its_warm_state(kinects):
    drift = read_rig(kinects / "truth.yaml").quality.depth_drift["C1"]
    cold, during, warm = abs(drift["101000"]), abs(drift["000002"]), abs(drift["201000"])
    assert cold > during > warm > 0


def test_stereo_has_a_field_in_disparity():
    field = stereo(640, 480, 0.009, np.random.default_rng(0))
    near, far = (field.error_m(np.full((480, 640), z)) for z in (1.0, 2.0))
    assert np.std(far) == pytest.approx(4 * np.std(near), rel=0.03)  # linear between depths 14 % apart
    assert STEREO.k_per_m * STEREO.product == pytest.approx(0.08, rel=0.05)  # px


def test_wiggling_goes_with_the_range_along_the_ray():
    rng = np.random.default_rng(3)
    length = np.linalg.norm(DEPTH_LENS.rays(nodes_px(512, 424)), axis=-1)
    field, bias = time_of_flight_field(512, 424, length, 0.006, rng), true_depth_bias(rng)
    along = np.linspace(0.8, 3.0, 200)
    middle = field.grid.error_m(np.broadcast_to([255.5, 211.5], (200, 2)), along)
    slopes = np.sign(np.diff(middle))
    assert np.count_nonzero(np.diff(slopes)) >= 3  # it turns round several times
    z_true_m = np.broadcast_to(np.linspace(0.8, 4.0, 512), (424, 512))
    z_m = reported(z_true_m, bias, field)
    np.testing.assert_allclose(bias.correct(z_m) + field.error_m(z_m), z_true_m, atol=1e-5)


def test_time_of_flight_noise_grows_with_range_and_on_black():
    length, sigmas_m = ray_lengths(), []
    for z, reflectance in ((1.0, 0.7), (3.0, 0.7), (1.0, 0.1)):
        full = np.ones((424, 512))
        depth = measure_time_of_flight(
            z * full, full, reflectance * full, length, TimeOfFlight(), no_depth_bias(), np.random.default_rng(0)
        )
        middle = depth[162:262, 206:306] / 1000
        assert middle.mean() == pytest.approx(z, abs=0.002)
        sigmas_m.append(middle.std())
    # k sqrt(A + 0.1) / A, and 0.29 mm of rounding
    assert sigmas_m == pytest.approx([0.00093, 0.0038, 0.0032], rel=0.15)


def test_flying_pixels_lie_between_the_two_surfaces_of_an_edge():
    z_m = np.where(np.arange(512) < 256, 1.0, 1.4) * np.ones((424, 1))
    z_m[:, 255] = 1.0
    full, length = np.ones((424, 512)), ray_lengths()
    depth = (
        measure_time_of_flight(z_m, full, 0.5 * full, length, QUIET, no_depth_bias(), np.random.default_rng(0)) / 1000
    )
    between = (depth > 1.03) & (depth < 1.37)
    columns = np.flatnonzero(between.any(axis=0))
    assert set(columns) <= {255, 256, 257} and len(columns)
    assert (depth[:, columns] == 0).any()  # most are recognised


def test_multipath_makes_depth_longer_and_pulls_black_most():
    full, length = np.ones((424, 512)), ray_lengths()
    reflectance = 0.7 * full
    reflectance[180:240, 200:300] = 0.1
    depth = measure_time_of_flight(
        2 * full, full, reflectance, length, QUIET, no_depth_bias(), np.random.default_rng(0), stray=0.02
    )
    off_mm = depth.astype(float) - 2000
    assert 0.2 < off_mm[20:100, 100:400].mean() < 5
    assert off_mm[195:225, 220:280].mean() > 3 * off_mm[20:100, 200:300].mean()


def test_brightness_falls_with_the_square_of_the_range():
    one = np.ones((2, 2))
    assert amplitude(2 * one, one, one, one) == pytest.approx(amplitude(one, one, one, one) / 4)


def edges_picture(z_m: float) -> IdealImage:
    light = np.full((120, 160, 3), 0.05, np.float32)
    light[:, 80:] = 0.5
    return IdealImage(light, np.full((120, 160), z_m), np.ones((120, 160)))


def edge_width(image: np.ndarray) -> float:
    profile = image[60, :, 1].astype(float)
    return (profile.max() - profile.min()) / np.abs(np.diff(profile)).max()


def test_blur_grows_away_from_focus_and_exposure_is_automatic():
    noise, optics = ColorNoise(sigma_grey=0.0, vignette=0.0), Optics(1.8, 2.2, 0.0)
    widths, greys = [], []
    for z in (1.8, 0.9, 0.6):
        image = develop(edges_picture(z), noise, np.random.default_rng(0), optics)
        widths.append(edge_width(image))
    assert widths[0] < widths[1] < widths[2]
    for level in (0.3, 1.0, 2.0):
        lit = np.full((120, 160), level)
        greys.append(develop(edges_picture(1.8), noise, np.random.default_rng(0), optics, lit).mean())
    np.testing.assert_allclose(greys, greys[0], atol=1.0)
    assert develop(edges_picture(1.8), noise, np.random.default_rng(0)).mean() != pytest.approx(greys[0], abs=3)


def test_less_light_is_more_noise():
    optics = Optics(1.8, 0.0, 0.0)
    flat = IdealImage(np.full((120, 160, 3), 0.2, np.float32), np.full((120, 160), 1.8), np.ones((120, 160)))
    noise = ColorNoise(blur_px=0.0, vignette=0.0)
    bright, dark = (
        develop(flat, noise, np.random.default_rng(0), optics, np.full((120, 160), level)).std()
        for level in (1.0, 0.25)
    )
    assert dark == pytest.approx(2 * bright, rel=0.1)


def test_fringes_move_red_and_blue_apart_along_the_radius():
    light = np.full((120, 160, 3), 0.05, np.float32)
    light[:, 140:] = 0.5
    image = develop(
        IdealImage(light, np.full((120, 160), 2.0), np.ones((120, 160))),
        ColorNoise(blur_px=0.0, sigma_grey=0.0, vignette=0.0, fringe_px=2.0),
        np.random.default_rng(0),
    )
    # 60 px from the middle of an image whose corners are 100 px away: 1.2 px outwards for red, inwards for blue
    where = [np.interp(120.0, image[60, :, c].astype(float), np.arange(160.0)) for c in range(3)]
    blue, green, red = where
    assert red - green == pytest.approx(1.2, abs=0.4) and green - blue == pytest.approx(1.2, abs=0.4)


def test_command_writes_depth_of_its_own_and_jpeg(run, tmp_path):
    small = (
        "--cameras",
        2,
        "--frames",
        1,
        "--intrinsic-views",
        0,
        "--distances",
        "1.5",
        "--width",
        160,
        "--height",
        120,
    )
    outcome = run(
        "simulate", tmp_path / "new", *small, "--jobs", 1, "--unregistered", "--sensor", "stereo", "--infrared",
        "--jpeg", 80, "--no-wall-errors",
    )  # fmt: skip
    assert outcome.status == 0, outcome.stderr
    assert len(list(tmp_path.glob("new/extrinsic/C1/color/*.jpg"))) == 1
    assert cv2.imread(str(tmp_path / "new/extrinsic/C1/ir/000000.png"), cv2.IMREAD_UNCHANGED).dtype == np.uint8
    assert (tmp_path / "new/depth_bias/C1/distances.csv").read_text().startswith("frame,distance_m\n")
    simulated = load_yaml(tmp_path / "new" / "truth.yaml")["provenance"]["simulated"]
    assert simulated["realism"]["tape_m"] == 0.0 and simulated["realism"]["print_aspect"] == 0.003


def test_command_refuses_what_does_not_go_together(run, tmp_path):
    for wrong in (("--infrared",), ("--depth-size", "512x424"), ("--lens", "pinhole")):
        outcome = run("simulate", tmp_path / "new", *wrong)
        assert outcome.status == 2 and wrong[0] in outcome.stderr
    assert list(tmp_path.iterdir()) == []


def test_ideal_time_of_flight_is_exact():
    full, rng = np.ones((424, 512)), np.random.default_rng(0)
    depth = measure_time_of_flight(
        1.5 * full, full, 0.5 * full, ray_lengths(), TimeOfFlight(ideal=True), true_depth_bias(rng), rng
    )
    assert np.all(depth == 1500)
    assert not IDEAL.has("multipath") and not IDEAL.has("drift")

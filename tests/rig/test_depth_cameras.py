"""Depth with a geometry of its own: cameras split in two, the depth camera found by planes or by infrared corners, joined again."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import synthetic_views as sv
from click.testing import CliRunner

from rgbd_calib.cli.main import cli
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.dataset import CameraInfo, DepthGeometry
from rgbd_calib.io.layout import KINDS
from rgbd_calib.io.recording import Recording, open_recording
from rgbd_calib.io.rig import read_rig
from rgbd_calib.pipeline.depth_cameras import by_device, joined, name_of, split, split_rig
from rgbd_calib.quality import AlignmentNumbers, CameraStatistics
from rgbd_calib.rig.bundle import bundle, problem_of
from rgbd_calib.rig.setup import BundleParams, CameraPrior, MountPrior
from rgbd_calib.simulation.views import true_views
from rgbd_calib.types import BoardView, DepthBias, PlacedView, Rig, RigCamera

DEPTH_LENS = Intrinsics(512, 424, 366.0, 367.0, 255.0, 209.0, (0.02, -0.03, 0.0, 0.0, 0.0))
K_PER_M, SIGMA_PX = 0.7e-3, 0.1
MOUNT_SD = np.repeat([0.03, 0.010], 3)


def true_mount(i: int) -> np.ndarray:
    return se3.retract(np.eye(4), np.array([0.010, -0.008, 0.004, 0.052 + 0.001 * i, -0.002, 0.001]))


def stated_mount(i: int) -> np.ndarray:
    """Some millimetres and half a degree off, as factories state it."""
    return true_mount(i) @ se3.retract(np.eye(4), np.array([0.006, 0.004, -0.003, 0.004, -0.003, 0.002]))


def stated_lens() -> Intrinsics:
    vector = DEPTH_LENS.vector.copy()
    vector[:4] += [2.0, 1.0, 3.0, -2.0]
    return DEPTH_LENS.with_vector(vector)


def seen_depth(placed: PlacedView, i: int, rng: np.random.Generator) -> PlacedView:
    """Depth of the board, read where the stated geometry has the corners, from the plane as it truly is."""
    board, n = sv.BOARD, len(placed.view.ids)
    T = se3.inverse(stated_mount(i)) @ placed.T_color_board
    pixels = stated_lens().project(se3.transform(T, placed.points_m(board)))
    T_true = se3.inverse(true_mount(i)) @ placed.T_color_board
    rays = DEPTH_LENS.rays(pixels)
    z = (T_true[:3, 3] @ T_true[:3, 2]) / (rays @ T_true[:3, 2])
    z = z + rng.normal(0, K_PER_M, n) * z**2
    view = BoardView(name_of(placed.view.camera), placed.view.frame, placed.view.ids, pixels, z, np.full(n, 20), True)
    return replace(placed, view=view, T_color_board=T)


def views_and_priors(
    seed: int, frames: int
) -> tuple[Rig, list[PlacedView], dict[str, CameraPrior], dict[str, np.ndarray]]:
    rng = np.random.default_rng(seed)
    rig = sv.arc(2)
    boards = sv.board_poses(rig, sv.BOARD, frames, rng)
    views = true_views(rig, boards, sv.BOARD, replace(sv.CORNER_NOISE, sigma_2d_px=SIGMA_PX), rng)
    placed = [replace(p, view=sv.without_depth(p.view)) for p in sv.placed_truly(rig, boards, views, sv.BOARD)]
    number = {name: i for i, name in enumerate(rig.cameras)}
    placed += [seen_depth(p, number[p.view.camera], rng) for p in placed]
    priors, T = dict[str, CameraPrior](), dict[str, np.ndarray]()
    no_bias = DepthBias((0.0,), 0.5, 4.0, 0.0, np.array([[1e-10]]))
    for name, own in rig.cameras.items():
        priors[name] = CameraPrior(own.intrinsics, None, False, None)
        priors[name_of(name)] = CameraPrior(
            stated_lens(), None, False, no_bias, same_sensor=True, mount=MountPrior(name, MOUNT_SD)
        )
        T[name] = own.T_world_color
        T[name_of(name)] = own.T_world_color @ stated_mount(number[name])
    return rig, placed, priors, T


def test_derivatives_agree_with_central_differences() -> None:
    _, placed, priors, T = views_and_priors(3, 4)
    problem, state, _ = problem_of(placed, sv.BOARD, priors, T, "C1", BundleParams())
    rng = np.random.default_rng(0)
    state = problem.moved(
        state,
        1e-3 * rng.normal(size=problem.n_globals) * problem.prior.free,
        1e-3 * rng.normal(size=(4, problem.unit_size)),
    )
    step = 1e-6
    depth_only = np.flatnonzero([p.view.predicted for p in placed])
    J = np.zeros((len(placed), placed[0].view.ids.size, problem.n_globals))
    for some, look, rows in problem.rows(state, depth_only, (np.ones(problem.obs.depth_m.shape),) * 2):
        if look.kind.value == "depth":
            np.add.at(J, (some[:, None, None], np.arange(J.shape[1])[None, :, None], rows.columns), rows.J[:, :, 0])
            at = rows.point_columns
            np.add.at(J, (some[:, None, None], np.arange(J.shape[1])[None, :, None], at), rows.J_point[:, :, 0])
    for k in np.flatnonzero(problem.prior.free):
        e = np.zeros(problem.n_globals)
        e[k] = step
        zero = np.zeros((4, problem.unit_size))
        ahead, behind = (problem.residuals(problem.moved(state, s * e, zero))[1][depth_only] for s in (1, -1))
        np.testing.assert_allclose(J[depth_only][..., k], (ahead - behind) / (2 * step), atol=2e-6, rtol=2e-5)


def test_a_depth_camera_without_images_is_found_by_the_boards_planes() -> None:
    errors, found = [], []
    for seed in range(4):
        rig, placed, priors, T = views_and_priors(seed, 25)
        solved = bundle(placed, sv.BOARD, priors, T, "C1", BundleParams(hold=("depth field",)))
        for i, name in enumerate(rig.cameras):
            T_true = rig.cameras[name].T_world_color @ true_mount(i)
            xi = se3.difference(T_true, solved.T_world_color(name_of(name)))
            own = solved.index("pose", name_of(name))
            if name == "C1":  # the reference's depth camera: no other pose in it
                errors.append(xi @ np.linalg.solve(solved.covariance[np.ix_(own, own)], xi) / 6)
            found.append(solved.intrinsics(name_of(name)).vector[:4] - DEPTH_LENS.vector[:4])
    # chi^2 with 6 degrees of freedom over 4 seeds: 4 standard errors of its mean
    assert np.mean(errors) < 1 + 4 * np.sqrt(2 / 6 / 4)
    # stated 2 and 3 px off; 25 planes tell the lens to a pixel or so
    assert np.sqrt(np.mean(np.square(found))) < 1.5


def info(**geometry: object) -> CameraInfo:
    return CameraInfo(640, 480, depth=DepthGeometry(512, 424, **geometry))  # type: ignore[arg-type]


def test_split_makes_two_cameras_and_joined_makes_one_again(tmp_path: Path) -> None:
    files = {kind: {"C1": {"000": tmp_path / kind}, "C2": {"000": tmp_path / kind}} for kind in KINDS}
    files["depth"]["C2"] = {}
    recording = Recording(
        tmp_path, {"C1": info(T_color_depth=true_mount(0)), "C2": CameraInfo(640, 480)}, None, {}, listed=files
    )
    two = split(recording)
    assert list(two.cameras) == ["C1", "C1/depth", "C2"]
    assert two.color_files["C1/depth"] == files["ir"]["C1"]
    assert two.depth_files["C1"] == {} and two.has_depth("C1/depth", "000")
    assert (two.cameras["C1/depth"].width, two.cameras["C1/depth"].depth) == (512, None)
    assert split(two) is two
    pose = se3.retract(np.eye(4), np.array([0.1, 0.2, -0.1, 1.0, 0.0, 0.3]))
    bias = DepthBias((0.01, 0.001), 0.5, 3.0, 0.001, None, (0.002, -0.001), True)
    rig = Rig(
        "C1",
        {
            "C1": RigCamera(sv.lens_of(0), pose, np.zeros((6, 6))),
            "C1/depth": RigCamera(
                DEPTH_LENS, pose @ true_mount(0), np.zeros((6, 6)), bias, CameraStatistics(depth_rms_m=0.002)
            ),
            "C2": RigCamera(sv.lens_of(1), np.eye(4), np.zeros((6, 6))),
        },
    )
    whole = joined(rig, two.cameras, None)
    assert list(whole.cameras) == ["C1", "C2"]
    depth = whole.cameras["C1"].depth_camera
    assert depth is not None and whole.cameras["C1"].depth_bias == bias
    np.testing.assert_allclose(depth.T_color_depth, true_mount(0), atol=1e-12)
    again = split_rig(whole, two).cameras["C1/depth"]
    np.testing.assert_allclose(again.T_world_color, pose @ true_mount(0), atol=1e-12)
    assert (again.depth_bias, again.statistics) == (bias, CameraStatistics(depth_rms_m=0.002))


def test_pairs_are_told_by_device() -> None:
    pairs = {
        "C1 - C1/depth": AlignmentNumbers(0, median_px=0.1),
        "C1 - C2": AlignmentNumbers(0, median_px=0.2),
        "C1/depth - C2/depth": AlignmentNumbers(5, mean_mm=1.0),
        "C1 - C2/depth": AlignmentNumbers(0),
    }
    assert by_device(pairs) == {
        "C1 - C1/depth": AlignmentNumbers(0, median_px=0.1),
        "C1 - C2": AlignmentNumbers(5, median_px=0.2, mean_mm=1.0),
    }


@pytest.fixture(scope="module")
def kinect2(real_data: Callable[[str], Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("kinect2") / "rig.yaml"
    result = CliRunner().invoke(cli, ["calibrate", str(real_data("kinect2_20")), "-o", str(out)])
    assert result.exit_code == 0, result.output
    return out


def test_a_real_kinect_v2_alone_is_a_rig_of_one(kinect2: Path) -> None:
    rig = read_rig(kinect2)
    assert list(rig.cameras) == ["kinect2"]
    own = rig.cameras["kinect2"]
    depth = own.depth_camera
    assert depth is not None and (depth.intrinsics.width, depth.intrinsics.height) == (512, 424)
    baseline_m = float(np.linalg.norm(depth.T_color_depth[:3, 3]))
    assert abs(baseline_m - 0.052) < 0.002  # by design
    # its board looks the same after a half turn: colour and infrared stand within a degree or two in all pairs
    angle = np.arccos((np.trace(depth.T_color_depth[:3, :3]) - 1) / 2)
    assert angle < np.radians(2)
    assert rig.quality.views_used == {"kinect2": 21, "kinect2/depth": 21}
    assert depth.covariance is not None and depth.covariance.shape == (10, 10)


def test_a_real_kinect_v2_is_fused_by_its_own_geometry(
    kinect2: Path, real_data: Callable[[str], Path], tmp_path: Path
) -> None:
    cloud = tmp_path / "cloud.ply"
    result = CliRunner().invoke(cli, ["fuse", str(real_data("kinect2_20")), "--rig", str(kinect2), "-o", str(cloud)])
    assert result.exit_code == 0, result.output
    assert cloud.exists()
    other = read_rig(kinect2)
    camera = replace(other.cameras["kinect2"], depth_camera=None)
    from rgbd_calib.pipeline.rig_inputs import check_depth_geometry

    with pytest.raises(Exception, match="not registered to colour; the rig's depth is of 1920x1080"):
        check_depth_geometry(open_recording(real_data("kinect2_20")), "kinect2", camera)


def test_squares_that_depth_contradicts_are_named(run, real_data: Callable[[str], Path], tmp_path: Path) -> None:
    """The published calibration of this Kinect v1 has a baseline of 35 mm for 25 mm: so wrong are its squares."""
    result = run("calibrate", real_data("kinect1_xw"), "-o", tmp_path / "rig.yaml")
    assert result.status == 1
    assert "measure the board's squares (40 mm stated)" in result.stderr


def test_a_kinect_without_infrared_images_is_a_rig_of_one(
    run, real_data: Callable[[str], Path], tmp_path: Path
) -> None:
    """With squares of the size that its depth says; published focal lengths, and the baseline of the design."""
    there, folder = real_data("kinect1_xw"), tmp_path / "kinect1"
    shutil.copytree(there, folder)
    dataset = folder / "dataset.yaml"
    dataset.write_text(dataset.read_text().replace("square: 0.04\n", "square: 0.0294\n"))
    result = run("calibrate", folder, "-o", tmp_path / "rig.yaml")
    assert result.status == 0, result.stderr
    rig = read_rig(tmp_path / "rig.yaml")
    assert list(rig.cameras) == ["kinect"]
    depth = rig["kinect"].depth_camera
    assert depth is not None
    np.testing.assert_allclose(rig["kinect"].intrinsics.vector[:2], [521.4, 520.6], rtol=0.01)
    np.testing.assert_allclose(depth.intrinsics.vector[:2], [582.4, 588.1], rtol=0.02)
    assert abs(float(np.linalg.norm(depth.T_color_depth[:3, 3])) - 0.025) < 0.004
    assert rig.quality.alignment_on_recording is None  # no corner was seen by two cameras
    assert rig.quality.self_check is not None and rig.quality.self_check.trusted, result.stderr
    assert not any(f.check == "scale" for f in rig.quality.self_check.findings)

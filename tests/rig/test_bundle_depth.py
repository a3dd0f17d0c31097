"""Depth in the bundle: its axis, its bias beyond the data, rounding, walls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import synthetic_views as sv
from test_bundle import draw, priors_of, solved

from rgbd_calib.cameras.wall import SeenWall, wall_cells
from rgbd_calib.geometry import se3
from rgbd_calib.rig import solve
from rgbd_calib.rig.bundle import bundle, problem_of
from rgbd_calib.rig.observations import Walls
from rgbd_calib.rig.reweight import MOST_K_WALL, reweighted
from rgbd_calib.rig.setup import BundleParams, CameraPrior
from rgbd_calib.rig.solution import Solution
from rgbd_calib.simulation.views import ViewNoise
from rgbd_calib.types import DepthBias, PlacedView


def test_depth_noise_that_is_smooth_over_the_board_is_seen_and_counted() -> None:
    rng = np.random.default_rng(3)
    rig = sv.arc(3, biased=True)
    smooth = ViewNoise(0.1, 0.7e-3, 1e-3)
    result = solved(rig, draw(rig, sv.BOARD, 14, rng, smooth), sv.BOARD, rng)
    white = solved(rig, draw(rig, sv.BOARD, 14, rng), sv.BOARD, rng)
    # an offset of 1e-3 z^2 shared by 54 corners of 0.7e-3: its part is sqrt(54) 1 / 0.7 = 10 times the rest
    assert result.problem.weights.ratio_depth[0] > 4
    assert white.problem.weights.ratio_depth.max() < 1.5


def test_a_sure_depth_bias_does_not_hide_what_the_recording_tells_of_the_lenses() -> None:
    """Information of 1e18 beside a focal length's 3e-4: what is little is not nothing."""
    rng = np.random.default_rng(5)
    rig = sv.arc(2, biased=True)
    views, priors = draw(rig, sv.BOARD, 14, rng), priors_of(rig, rng)
    sure = DepthBias(rig.cameras["C2"].depth_bias.coefficients, 0.5, 4.0, 0.0, 1e-18 * np.eye(3))
    priors["C2"] = replace(priors["C2"], bias=sure)
    result = bundle(views, sv.BOARD, priors, {n: c.T_world_color for n, c in rig.cameras.items()}, "C1")
    assert not result.observability.undetermined[result.index("intrinsics", "C1")[:4]].any()
    assert np.all(
        np.abs(result.state.intrinsics[0] - rig.cameras["C1"].intrinsics.vector)[:2] < 0.5
    )  # 2 px at the start


def test_the_axis_of_the_depth_is_found_and_stands_in_the_depth_camera() -> None:
    rng = np.random.default_rng(8)
    rig, tilt_rad = sv.arc(2, biased=True), np.array([0.0025, -0.0015])

    def tilted(placed: PlacedView) -> PlacedView:
        if placed.view.camera != "C2":
            return placed
        rays = rig.cameras["C2"].intrinsics.rays(placed.view.corners_px)[:, :2]
        return replace(placed, view=replace(placed.view, depth_m=placed.view.depth_m / (1 + rays @ tilt_rad)))

    views = [tilted(placed) for placed in draw(rig, sv.BOARD, 20, rng)]
    T = {name: own.T_world_color for name, own in rig.cameras.items()}
    few = BundleParams(hold=("depth field",))  # which tells them apart only by how they grow with the distance
    sure = np.r_[np.full(4, 0.05), np.full(5, 1e-4)]  # a centre that is off turns the camera, and so the depth's axis
    priors = {name: CameraPrior(own.intrinsics, sure, False, own.depth_bias) for name, own in rig.cameras.items()}
    result = bundle(views, sv.BOARD, priors, T, "C1", few)
    at = result.index("depth tilt", "C2")
    error, covariance = result.state.values["depth tilt"][1] - tilt_rad, result.covariance[np.ix_(at, at)]
    assert np.all(np.sqrt(np.diag(covariance)) < 1e-3)
    assert error @ np.linalg.solve(covariance, error) < 11.8  # 3 sigma of two
    found = result.depth_camera("C2")
    assert found is not None
    pixels_px = np.array([[50.0, 50.0], [600.0, 100.0], [300.0, 450.0]])
    ahead_m = se3.transform(found.T_color_depth, found.intrinsics.unproject(pixels_px, np.full(3, 2.0)))[:, 2]
    rays = found.intrinsics.rays(pixels_px)[:, :2]
    assert ahead_m == pytest.approx(2.0 * (1 + rays @ result.state.values["depth tilt"][1]), abs=1e-4)


def test_depth_beyond_the_data_goes_on_as_the_curve_does_and_says_how_surely() -> None:
    rng = np.random.default_rng(9)
    rig = sv.arc(2, biased=True)
    T = {name: own.T_world_color for name, own in rig.cameras.items()}
    views = draw(rig, sv.BOARD, 20, rng)
    result = bundle(views, sv.BOARD, priors_of(rig, rng, with_bias=False), T, "C1")
    for name, own in rig.cameras.items():
        found = result.depth_bias(name)
        assert found is not None and own.depth_bias is not None and found.data_m is not None
        measured = np.concatenate([p.view.depth_m for p in views if p.view.camera == name])
        assert found.measured_m == (np.nanmin(measured), np.nanmax(measured))
        assert (found.min_m, found.max_m) == pytest.approx(found.measured_m * np.array([1 / 1.3, 1.3]))
        beyond_m = np.linspace(*found.measured_m, 7)[-1] * 1.2
        error_m, sd_m = found.correct(beyond_m) - own.depth_bias.correct(beyond_m), found.standard_error(beyond_m)
        assert abs(error_m) < 3 * sd_m
        assert sd_m > found.standard_error(found.measured_m[1])


def test_depth_that_is_rounded_more_than_noisy_weighs_less() -> None:
    rng = np.random.default_rng(3)
    rig = sv.arc(2, biased=True)
    views, priors = draw(rig, sv.BOARD, 8, rng), priors_of(rig, rng)
    T = {name: own.T_world_color for name, own in rig.cameras.items()}

    def with_unit(unit_m: float) -> Solution:
        of_unit = {name: replace(prior, depth_unit_m=unit_m) for name, prior in priors.items()}
        return bundle(views, sv.BOARD, of_unit, T, "C1", BundleParams(hold=("depth field",)))

    fine, coarse = with_unit(1e-6), with_unit(0.01)
    assert fine.problem.weights.robust_depth.max(axis=1) == pytest.approx(1, abs=1e-6)
    # noise of 0.7e-3 z^2, as estimated from some 800 depths, and on top a rounding of 10 mm / sqrt(12)
    z2_m2 = np.mean(coarse.problem.obs.depth_m**4, axis=1) ** 0.5
    noise_m, rounding_m = np.sqrt(np.mean(coarse.problem.weights.ratio_depth**2)) * 0.7e-3 * z2_m2, 0.01 / np.sqrt(12)
    assert coarse.problem.weights.robust_depth.max(axis=1) == pytest.approx(
        noise_m**2 / (noise_m**2 + rounding_m**2), rel=0.1
    )
    assert np.all(
        np.diag(coarse.covariance)[coarse.index("pose", "C2")] > np.diag(fine.covariance)[fine.index("pose", "C2")]
    )


def test_walls_that_fit_badly_are_not_taken_for_noise() -> None:
    """Else an estimate that something pulls away from the walls would put them out, and stay there."""
    rng = np.random.default_rng(1)
    rig = sv.arc(2, biased=True)
    T = {name: own.T_world_color for name, own in rig.cameras.items()}
    walls = []
    for z_m in (1.0, 1.5, 2.0, 3.0):
        cells = wall_cells(np.full((480, 640), z_m))
        off_m = 0.05 * z_m**2 * np.where(cells.pixels_px[..., 0] < 320, 1.0, -1.0)
        walls.append(SeenWall(f"{z_m}", z_m, 0.002, replace(cells, depth_m=cells.depth_m + off_m)))
    seen = Walls.of(list(rig.cameras), {"C2": walls})
    views = draw(rig, sv.BOARD, 8, rng)
    own, state, _ = problem_of(views, sv.BOARD, priors_of(rig, rng), T, "C1", BundleParams(), seen)
    again = reweighted(own, state, solve.covariance(own, state))
    assert again.k_wall[1] == MOST_K_WALL

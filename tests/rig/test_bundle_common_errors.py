"""Errors that all views of a camera share: found where they are, counted in the covariance, and none seen where none are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import synthetic_views as sv
from test_bundle import NOISE, draw, priors_of, solved

from rgbd_calib.geometry import se3
from rgbd_calib.rig.bundle import bundle
from rgbd_calib.types import PlacedView


def rippled(view: PlacedView, phase_rad: float) -> PlacedView:
    """Depth with a ripple over the range, of 2 noise deviations RMS and a period of 0.5 m."""
    z = view.view.depth_m
    shared = 2 * np.sqrt(2) * NOISE.k_depth_per_m * z**2 * np.sin(2 * np.pi * z / 0.5 + phase_rad)
    return replace(view, view=replace(view.view, depth_m=z + shared))


def patterned(view: PlacedView, pattern: np.ndarray) -> PlacedView:
    """Depth with an error in disparity of each cell of the image, `pattern` in noise deviations."""
    z, (across, down) = view.view.depth_m, np.floor(view.view.corners_px.T / 640 * len(pattern)).astype(int)
    shared = NOISE.k_depth_per_m * z**2 * pattern[across, down]
    return replace(view, view=replace(view.view, depth_m=z + shared))


def test_what_depths_share_over_the_image_is_stated_camera_by_camera() -> None:
    rng, rig, board = np.random.default_rng(0), sv.ring(2, biased=True), sv.TWO_SIDED
    pattern = {"C1": np.zeros((16, 12)), "C2": rng.normal(size=(16, 12))}
    views = [patterned(view, pattern[view.view.camera]) for view in draw(rig, board, 60, rng)]
    result = solved(rig, views, board, rng)
    clean, own = result.common.depth_image
    # of 1 noise deviation, less what the smooth field follows, in units of a noise that holds some of the rest
    assert clean < 0.2 and 0.5 < own < 1.2
    z_m = np.array([1.0, 2.0])
    stated = [result.depth_field(name).pattern_variance_m2(z_m) ** 0.5 for name in ("C1", "C2")]
    np.testing.assert_allclose(stated[1], own * result.problem.weights.k_depth[1] * z_m**2)
    assert np.all(stated[0] < 0.2 * stated[1])


def test_what_corners_of_one_view_share_is_not_the_sensors() -> None:
    """Neighbours in a view err alike, otherwise in each view: no more than a board's shape, it tells nothing of other places."""
    rng, rig, board = np.random.default_rng(0), sv.ring(2, biased=True), sv.TWO_SIDED
    views = [patterned(view, rng.normal(size=(16, 12))) for view in draw(rig, board, 60, rng)]
    result = solved(rig, views, board, rng)
    # by all pairs of a cell tau^2 is 0.016 and 0.020; by those of two views it is known to 0.006 here
    assert np.all(result.common.depth_image**2 < 2 * 0.006)


@pytest.mark.parametrize("ripple", [False, True])
def test_what_depths_share_is_found_and_counted(ripple: bool) -> None:
    seeds, counted, tau, offset, k = 6, [], [], [], []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        rig, board = sv.ring(2, biased=True), sv.TWO_SIDED
        views = draw(rig, board, 15, rng)
        phases = {name: rng.uniform(0, 2 * np.pi) for name in rig.cameras}
        views = [rippled(view, phases[view.view.camera]) for view in views] if ripple else views
        result = solved(rig, views, board, rng)
        tau.append(result.common.depth)
        offset.append(result.problem.weights.ratio_depth[0])
        k.append(result.problem.weights.k_depth / NOISE.k_depth_per_m)
        xi = se3.difference(rig.cameras["C2"].T_world_color, result.state.T_world_color[1])
        counted.append(xi @ np.linalg.solve(result.pose_covariance("C2"), xi) / 6)
    # chi^2 with 6 degrees of freedom over the seeds, 4 standard errors
    assert abs(np.mean(counted) - 1) < 4 * np.sqrt(2 / 6 / seeds)
    if ripple:
        # each board is at one distance, so that the ripple is an offset of the whole board: 2 deviations of 54 corners are
        # sqrt(54) 2 = 15 of one, less what bias and field follow; the noise of a corner is what it was, but for the board's depth
        assert 7 < np.mean(offset) < 15
        assert 0.9 < np.mean(k) < 1.3
    else:
        # 48 cells of n = 34 corners: tau^2 has the standard error sqrt(2 / 48) / 34 = 0.006, 4 of them
        assert max(tau) < np.sqrt(4 * 0.006)


def test_the_wiggle_of_time_of_flight_is_followed() -> None:
    rng = np.random.default_rng(0)
    rig, board = sv.ring(2, biased=True), sv.TWO_SIDED
    views = [rippled(view, 0.3) for view in draw(rig, board, 30, rng)]
    priors = {name: replace(prior, time_of_flight=True) for name, prior in priors_of(rig, rng).items()}
    result = bundle(views, board, priors, {n: c.T_world_color for n, c in rig.cameras.items()}, "C1")
    bias = result.depth_bias("C1")
    assert bias is not None
    z_m = np.concatenate([p.view.depth_m for p in views if p.view.camera == "C1"])
    z_m = z_m[np.isfinite(z_m)]
    without = replace(bias, ripple_m=(), covariance=None)
    ripple = -2 * np.sqrt(2) * NOISE.k_depth_per_m * z_m**2 * np.sin(2 * np.pi * z_m / 0.5 + 0.3)
    left = ripple - (bias.error_m(z_m) - without.error_m(z_m))
    # half of the waves' variance at least: the depths of 30 boards leave gaps, and the noise is half as large as the ripple
    assert np.var(left) < 0.5 * np.var(ripple)

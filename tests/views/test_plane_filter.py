"""Measured corners off their board's plane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from synthetic_views import BOARD, CORNER_NOISE, arc, board_poses, without_depth

from rgbd_calib.simulation.views import true_views
from rgbd_calib.views.plane_filter import PlaneFilterParams, filter_planes

RIG = arc(2)
LENSES = {name: own.intrinsics for name, own in RIG.cameras.items()}


def some_views(seed=0, frames=4):
    rng = np.random.default_rng(seed)
    return true_views(RIG, board_poses(RIG, BOARD, frames, rng), BOARD, CORNER_NOISE, rng)


def test_good_views_pass_as_they_are():
    views = some_views()
    result = filter_planes(views, LENSES, {})
    # sigma is 0.7e-3 z^2, the threshold 5e-3 z^2: seven sigma
    assert result.dropped_corners == 0
    assert result.dropped_views == ()
    for before, after in zip(views, result.views, strict=True):
        np.testing.assert_array_equal(before.depth_m, after.depth_m)


def test_corners_off_the_plane_lose_their_depth_and_are_counted():
    rng = np.random.default_rng(1)
    views, wrong = [], []
    for view in some_views():
        at = rng.choice(BOARD.n_corners, 12, replace=False)
        depth_m = view.depth_m.copy()
        depth_m[at] += rng.choice([-1, 1], 12) * rng.uniform(0.1, 0.6, 12)  # an edge, a hand; the threshold is 20 mm
        depth_m[at[0]] = np.nan
        views.append(replace(view, depth_m=depth_m))
        wrong.append(np.sort(at))
    result = filter_planes(views, LENSES, {})
    for view, at in zip(result.views, wrong, strict=True):
        np.testing.assert_array_equal(np.flatnonzero(np.isnan(view.depth_m)), at)
    assert result.dropped_corners == 11 * len(views)
    assert np.isfinite(views[0].depth_m).sum() == BOARD.n_corners - 1  # what was given is not changed


def test_depth_without_a_plane_is_dropped_whole_and_named():
    rng = np.random.default_rng(2)
    views = list(some_views())
    views[1] = replace(views[1], depth_m=rng.uniform(0.5, 3.0, BOARD.n_corners))
    result = filter_planes(views, LENSES, {})
    assert result.dropped_views == ((views[1].camera, views[1].frame),)
    assert np.isnan(result.views[1].depth_m).all()
    assert np.isfinite(result.views[0].depth_m).all()


def test_views_without_depth_pass():
    views = [without_depth(view) for view in some_views()]
    result = filter_planes(views, LENSES, {}, PlaneFilterParams())
    assert result.views == tuple(views)
    assert result.dropped_corners == 0


def test_same_seed_same_result():
    rng = np.random.default_rng(3)
    views = [replace(v, depth_m=v.depth_m + rng.normal(0, 0.02, len(v.ids))) for v in some_views()]
    first, second = (filter_planes(views, LENSES, {}, seed=7) for _ in range(2))
    for a, b in zip(first.views, second.views, strict=True):
        np.testing.assert_array_equal(a.depth_m, b.depth_m)

"""Depth that is no depth along the axis, or of another unit, is refused before any fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rgbd_calib.errors import CalibrationError
from rgbd_calib.simulation.session import BOARD, draw_scene
from rgbd_calib.simulation.views import true_views
from rgbd_calib.types import BoardView, DepthBias
from rgbd_calib.views.board_pose import pose_view
from rgbd_calib.views.depth_scale import check_axis, check_depth_scale, growth_with_ray

SCENE = draw_scene(2, "arc", 12, 0, np.random.default_rng(0))


def posed(change=lambda view, rays: view.depth_m, cameras=("C1", "C2")):
    out = []
    for view in true_views(SCENE.rig, SCENE.boards, BOARD, SCENE.noise, np.random.default_rng(0)):
        lens = SCENE.rig.cameras[view.camera].intrinsics
        rays = np.linalg.norm(lens.rays(view.corners_px), axis=1)
        depth_m = change(view, rays) if view.camera in cameras else view.depth_m
        own: BoardView = replace(view, depth_m=depth_m)
        out.append(pose_view(own, BOARD, lens, None))
    return out


def test_distances_along_the_rays_are_refused():
    wrong = posed(lambda view, rays: view.depth_m * rays, ("C2",))
    with pytest.raises(CalibrationError, match="C2: depth along the camera's axis expected, distances along the rays"):
        check_axis(wrong, BOARD)
    for name, exponent in (("C1", 0.0), ("C2", 1.0)):
        growth = growth_with_ray([p for p in wrong if p.view.camera == name], BOARD)
        assert abs(growth - exponent) < 0.1


@pytest.mark.parametrize(
    "change",
    [
        lambda view, rays: view.depth_m,
        lambda view, rays: view.depth_m * 1.1,
        lambda view, rays: view.depth_m + 0.025 * (rays - 1),  # 5 mm at the border of the image, at any distance
        lambda view, rays: np.full(len(rays), np.nan),
    ],
)
def test_depth_along_the_axis_passes(change):
    check_axis(posed(change), BOARD)


def test_another_unit_is_named():
    with pytest.raises(CalibrationError, match="C2: depth_scale looks 10 times too large"):
        check_depth_scale(posed(lambda view, rays: 10 * view.depth_m, ("C2",)), BOARD, {})
    check_depth_scale(posed(), BOARD, {})


def test_a_bias_that_makes_good_depth_wrong_is_named():
    with pytest.raises(
        CalibrationError, match=r"^C2: depth on the board agrees .* as it is measured .* distances of the bias"
    ):
        check_depth_scale(posed(), BOARD, {"C2": DepthBias((0.0, -0.4), 0.5, 4.0, 0.0)})

"""The paper's scenes: points that really are on surfaces seen by all cameras."""

from __future__ import annotations

import numpy as np
import pytest

from rgbd_calib.geometry import camera, se3
from rgbd_calib.simulation.features import paper_scene, visible_points
from rgbd_calib.simulation.scene import Caster


@pytest.mark.parametrize("n_cameras", [2, 4])
def test_points_are_seen_by_all_cameras_and_not_on_the_floor(n_cameras):
    scene, intrinsics, T_world_color = paper_scene(n_cameras)
    np.testing.assert_array_equal(T_world_color["C1"], np.eye(4))
    caster = Caster(scene)
    p_world = visible_points(caster, intrinsics, T_world_color, 300, np.random.default_rng(0))
    assert p_world.shape == (300, 3)
    floor = scene.quads_of("floor")
    for c, K in intrinsics.items():
        p_color = se3.transform(se3.inverse(T_world_color[c]), p_world)
        px = camera.project(K.vector, p_color)
        assert np.all((px > -0.5) & (px < [K.width - 0.5, K.height - 0.5]))
        assert p_color[:, 2].min() > 0.5
        hits = caster.cast(T_world_color[c][:3, 3], p_world - T_world_color[c][:3, 3])
        np.testing.assert_allclose(hits.t, 1.0, atol=2e-3)
        assert not np.isin(hits.quad, floor).any()


def test_same_seed_same_points():
    scene, intrinsics, T_world_color = paper_scene(2)
    a, b = (visible_points(scene, intrinsics, T_world_color, 50, np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(a, b)


def test_other_numbers_of_cameras_are_refused():
    with pytest.raises(ValueError, match="2 or 4"):
        paper_scene(3)

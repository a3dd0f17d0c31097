"""Ways to spoil a session, of prints and sensors as they are met too: what is said to be true afterwards is."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from rgbd_calib.geometry import se3
from rgbd_calib.simulation.faults import FAULTS, RINGS
from rgbd_calib.simulation.faults.common import swapped_walls, with_pixels
from rgbd_calib.simulation.realism import Realism
from rgbd_calib.simulation.session import draw_scene, film
from rgbd_calib.trust.uncertainty import observe, place


@pytest.fixture(scope="module")
def scenes():
    return {ring: draw(ring) for ring in (False, True)}


def draw(ring: bool):
    layout, cameras = ("ring", 4) if ring else ("arc", 3)
    return draw_scene(cameras, layout, 6, 3, np.random.default_rng(1), realism=Realism())


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_goes_with_real_prints_and_sensors(fault, scenes):
    session = FAULTS[fault](scenes[fault in RINGS], np.random.default_rng(zlib.crc32(fault.encode())))
    assert session.views
    assert session.board.shape is None  # nobody states what nobody knows


@pytest.mark.parametrize(("scale", "offset_px"), [(-1.0, (639.0, 479.0)), (1.03, (-6.0, -9.0))])
def test_cameras_with_other_pixels_see_the_same_world(scale, offset_px, scenes):
    rig, offset = scenes[False].rig, np.array(offset_px)
    now = with_pixels(rig, "C2", scale, offset, roll=scale < 0)
    at = rig.cameras["C2"].T_world_color
    rays = np.random.default_rng(0).uniform(-0.3, 0.3, (200, 2))
    points = se3.transform(at, np.column_stack([rays, np.ones(200)]) * np.linspace(1, 3, 200)[:, None])
    before, after = observe(rig, "C2", points), observe(now, "C2", points)
    np.testing.assert_allclose(after.pixels_px, scale * before.pixels_px + offset, atol=1e-8)
    np.testing.assert_allclose(after.raw_m, before.raw_m, atol=1e-9)
    np.testing.assert_allclose(place(now, "C2", after), points, atol=1e-9)
    colour = [r.cameras["C2"].intrinsics.project(se3.transform(se3.inverse(r.cameras["C2"].T_world_color), points)) for r in (rig, now)]  # fmt: skip
    np.testing.assert_allclose(colour[1], scale * colour[0] + offset, atol=1e-8)


def test_walls_are_swapped_with_their_cells(scenes):
    session = film(scenes[False], np.random.default_rng(0))
    swapped = swapped_walls(session, {"C1": "C2", "C2": "C1"})
    assert session.walls and session.wall_cells and swapped.walls and swapped.wall_cells
    for a, b in (("C1", "C2"), ("C2", "C1"), ("C3", "C3")):
        np.testing.assert_array_equal(swapped.walls[a], session.walls[b])
        np.testing.assert_array_equal(swapped.wall_cells[a], session.wall_cells[b])


def test_a_wall_fills_the_image_with_cells_about_its_distance(scenes):
    session = film(scenes[False], np.random.default_rng(0))
    assert session.walls is not None and session.wall_cells is not None
    for name, own in session.truth.cameras.items():
        for (measured, written, sd), cells in zip(session.walls[name], session.wall_cells[name], strict=True):
            u, v, z_m = cells.T
            assert u.min() == 7.5 and u.max() == 631.5 and v.max() == 471.5
            # the plane through the middle, where the field and a tilt of 2 degrees are some per cent
            assert abs(np.median(z_m) / measured - 1) < 0.03
            true_m = own.depth_sensor.correct(cells[:, :2], z_m)
            plane = np.linalg.lstsq(np.column_stack([u, v, np.ones_like(u)]), 1 / true_m, rcond=None)
            at_axis = 1 / (np.array([own.intrinsics.cx, own.intrinsics.cy, 1.0]) @ plane[0])
            # registration moves the foot of the axis by some px on a wall 2 degrees out of square
            assert abs(at_axis - written) < 5 * np.hypot(sd, 0.0015) + 0.001


def test_lenses_of_other_kinds_are_filmed_too():
    scene = draw_scene(2, "arc", 4, 2, np.random.default_rng(2), lenses=("fisheye", "rational"))
    session = film(scene, np.random.default_rng(0))
    assert [own.intrinsics.model for own in session.truth.cameras.values()] == ["kannala_brandt", "opencv"]
    for view in session.views:
        own = session.truth.cameras[view.camera]
        p = own.depth_sensor.points(view.corners_px, view.depth_m)
        T_color_board = se3.inverse(own.T_world_color) @ session.boards[view.frame]
        on_board = se3.transform(se3.inverse(T_color_board), p)
        assert np.abs(on_board[:, 2] - on_board[:, 2].mean()).max() < 0.03

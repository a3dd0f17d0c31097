"""Whole depth images: as the sensor has single pixels, and seen by another camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_depth_sensor import BIAS, COLOR, field, grid_field

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.depth_error import PolynomialField
from rgbd_calib.geometry.depth_image import DepthImage, seen_by
from rgbd_calib.geometry.depth_sensor import DepthCamera, DepthSensor
from rgbd_calib.pipeline.correct import correct_depth
from rgbd_calib.quality import CameraStatistics
from rgbd_calib.types import RigCamera

SMALL = Intrinsics(160, 120, 140.0, 141.0, 80.5, 59.0, (0.05, -0.1, 0.001, -0.001, 0.0))
V, U = np.mgrid[:120, :160]
PIXELS = np.stack([U, V], axis=-1).reshape(-1, 2).astype(float)


@pytest.mark.parametrize("own", [None, field((160, 120)), grid_field()], ids=["none", "polynomial", "grid"])
def test_an_image_is_all_its_pixels(own):
    sensor = DepthSensor(DepthCamera(SMALL, se3.retract(np.eye(4), np.array([0.01, 0, 0, 0.02, 0, 0.001]))), BIAS, own)
    z_m = np.random.default_rng(0).uniform(0.3, 5.0, (120, 160))
    z_m[3, 4] = np.nan
    points = DepthImage(sensor).points(z_m)
    expected = sensor.points(PIXELS, z_m.ravel()).reshape(120, 160, 3)
    assert np.isnan(points[3, 4]).all()
    np.testing.assert_allclose(points, expected, atol=1e-12)


@pytest.mark.parametrize("shift_px", [0.0, 0.5, 1.4])
@pytest.mark.parametrize("scale", [0.995, 1.0, 1.004])
def test_a_wall_beside_its_colour_image_is_laid_on_it_without_gaps(shift_px, scale):
    wrong = replace(SMALL, fx=SMALL.fx * scale, fy=SMALL.fy * scale, cx=SMALL.cx + shift_px)
    sensor = DepthSensor(DepthCamera(wrong))
    tilted = np.array([0.1, -0.05, 1.0])
    z_m = 2.0 / (wrong.rays(PIXELS) @ tilted).reshape(120, 160)
    seen = seen_by(DepthImage(sensor).points(z_m), SMALL)
    true_m = 2.0 / (SMALL.rays(PIXELS) @ tilted).reshape(120, 160)
    inner = seen[3:-3, 3:-3]
    assert np.isfinite(inner).all()
    assert (
        np.abs(inner - true_m[3:-3, 3:-3]).max() < 2.0 * 0.11 * 0.75 / SMALL.fx * 2.0
    )  # slope times three quarters of a pixel


def test_what_is_hidden_stays_hidden_and_what_was_not_seen_stays_empty():
    """A box in front of a wall, seen from 5 cm beside: it covers part of the wall, and shows some that the sensor missed."""
    sensor = DepthSensor(DepthCamera(SMALL, se3.retract(np.eye(4), np.array([0.0, 0, 0, 0.05, 0, 0]))))
    z_m = np.full((120, 160), 2.0)
    z_m[40:80, 60:100] = 1.0
    seen = seen_by(DepthImage(sensor).points(z_m), SMALL)
    row = seen[60, 10:150]
    assert {1.0, 2.0} == set(np.round(row[np.isfinite(row)], 6))
    # 5 cm are 7 px at 1 m and 3.5 px at 2 m: the shadow beside the box
    assert 2 <= np.isnan(row).sum() <= 5
    assert np.count_nonzero(row == row[np.nanargmin(row)]) == 40


def test_corrected_depth_has_neither_field_nor_shift():
    wrong = replace(COLOR, cx=COLOR.cx + 1.5, cy=COLOR.cy - 0.7)
    own = field((640, 480))
    assert isinstance(own, PolynomialField)
    camera = RigCamera(COLOR, np.eye(4), np.zeros((6, 6)), BIAS, CameraStatistics(), own, DepthCamera(wrong))
    u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
    wall = COLOR.rays(pixels) * 1.8
    reported_at, reported = camera.depth_sensor.report(wall)
    depth = np.zeros((480, 640))
    at = np.rint(reported_at).astype(int)
    inside = ((at >= 0) & (at < [640, 480])).all(axis=1)
    depth[at[inside, 1], at[inside, 0]] = reported[inside]
    corrected, lost, _ = correct_depth(np.rint(depth / 1e-4).astype(np.uint16), 1e-4, camera)
    inner = corrected[5:-5, 5:-5]
    assert lost == 0
    # the report was rounded to whole pixels: some of its lines are empty, and stay so
    assert np.count_nonzero(inner) > 0.98 * inner.size
    assert np.abs(inner[inner > 0] * 1e-4 - 1.8).max() < 2e-4

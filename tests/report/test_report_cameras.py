"""What the report says of lenses and depth errors, and of rigs before and after."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_report_sections import LENS, residuals, rig_camera

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.depth_error import PolynomialField
from rgbd_calib.quality import BiasSamples
from rgbd_calib.report import camera_pages
from rgbd_calib.types import DepthBias, DepthCamera


def test_lens_parameters_their_deviation_and_start():
    lens = replace(LENS, distortion=(0.1, -0.2, 0.0, 0.0, 0.3))
    found = camera_pages.parameters(lens, [0.5] * 9, LENS)
    assert [p.name for p in found] == ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"]
    assert (found[4].value, found[4].sd) == (0.1, 0.5) and found[2].start == 319.5
    assert camera_pages.parameters(lens, None, None)[0].sd is None


def test_distortion_and_change_in_pixels():
    pixels = np.array([[[319.5, 239.5], [569.5, 239.5]]])
    np.testing.assert_allclose(camera_pages.distortion_at(LENS, pixels), 0, atol=1e-9)
    lens = replace(LENS, distortion=(0.04, 0.0, 0.0, 0.0, 0.0))
    # the ray x = 0.5 is seen at x (1 + 0.04 x^2): 2.5 px outwards of an ideal lens
    at = lens.project(np.array([[0.5, 0.0, 1.0]]))
    np.testing.assert_allclose(camera_pages.distortion_at(lens, at), [[2.5, 0.0]], atol=1e-6)
    moved = replace(LENS, cx=LENS.cx + 3, cy=LENS.cy - 1)
    np.testing.assert_allclose(camera_pages.change_at(moved, LENS, pixels), np.broadcast_to([3, -1], (1, 2, 2)))
    drawn, scale, top = camera_pages.shift_over_image(LENS, lambda p: camera_pages.change_at(moved, LENS, p), "change")
    assert top == pytest.approx(np.sqrt(10))
    arrows = drawn["data"][1]
    assert arrows["x"][1] - arrows["x"][0] == pytest.approx(3 * scale, abs=0.02)


def test_arrows_of_a_folding_lens_do_not_cross_the_picture():
    def shift(pixels: np.ndarray) -> np.ndarray:
        out = np.zeros(pixels.shape)
        out[..., 0] = 1.0
        out[-1, -1] = [500.0, 0.0]
        return out

    drawn, _, top = camera_pages.shift_over_image(LENS, shift, "distortion")
    assert top == 500.0
    x = np.array([v for v in drawn["data"][1]["x"] if v is not None])
    assert len(x) == 5 * (np.prod(camera_pages.COARSE) - 1) and x.max() < 640


def test_the_depth_field_is_reported_less_true():
    """As the depth sensor corrects it: what it takes away is what the sensor reads too far."""
    field = PolynomialField(640, 480, 1, (0.0, 0.0), np.array([0.004, 0.0]), 0.5, 4.0)
    own = rig_camera(depth_field=field, depth_bias=DepthBias((0.0,), 1.0, 3.0, 0.001))
    maps = camera_pages.depth_over_image(own)
    assert [z for z, _, _, _ in maps] == [1.0, 2.0, 3.0]
    _, _, pixels = camera_pages.pixels_over(LENS, camera_pages.FINE)
    z = np.full(pixels.shape[:-1], 2.0)
    expected = 1e3 * (z - own.depth_sensor.correct(pixels, z))
    np.testing.assert_allclose(maps[1][3]["data"][0]["z"], expected, atol=1e-3)
    assert maps[1][2] == pytest.approx(np.sqrt(np.mean(expected**2))) and maps[1][1] is None
    assert camera_pages.depth_over_image(rig_camera()) == []


def test_registration_is_the_shift_of_the_depth_image():
    """A baseline of 20 mm at 2 m and f = 500 px is 5 px, whatever the pixel."""
    T = se3.make(np.eye(3), np.array([0.02, 0.0, 0.0]))
    C = np.zeros((10, 10))
    C[7, 7] = 0.001**2
    found, drawn, _ = camera_pages.beside(rig_camera(depth_camera=DepthCamera(LENS, T, C)), 2.0)
    assert found.rms_px == pytest.approx(5.0) and found.baseline_mm == pytest.approx(20.0)
    assert found.baseline_sd_mm == pytest.approx(1.0) and found.turn_deg == 0 and drawn is not None
    far = se3.make(np.eye(3), np.array([0.5, 0.0, 0.0]))
    found, drawn, _ = camera_pages.beside(rig_camera(depth_camera=DepthCamera(LENS, far)), 1.0)
    assert np.isnan(found.rms_px) and drawn is None and found.baseline_sd_mm is None
    assert camera_pages.beside(rig_camera(), 1.0) is None


def test_the_bias_curve_and_the_boards_on_it():
    bias = DepthBias((0.01, 0.0), 1.0, 3.0, 0.001)
    left = residuals([("C1", str(z), (1, 1), (0, 0), z, 0.002, True, True) for z in (1.0, 2.0)])
    drawn = camera_pages.depth_bias(bias, BiasSamples(np.array([1.5]), np.array([1.52])), left, 0)
    by_name = {t["name"]: t for t in drawn["data"]}
    np.testing.assert_allclose(by_name["correction"]["y"], 10.0)
    assert by_name["bias recording"]["y"] == [20.0]
    # corrected less 2 mm of residual: the board says 8
    np.testing.assert_allclose(by_name["boards, one dot a view"]["y"], 8.0)

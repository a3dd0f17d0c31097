"""A depth sensor: its field over the image, from pixels to points and back, and its form in files."""

from dataclasses import replace

import numpy as np
import pytest

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.depth_error import CellPattern, DepthBias, GridField, PolynomialField, n_terms, terms
from rgbd_calib.geometry.depth_sensor import DepthCamera, DepthSensor
from rgbd_calib.io.rig import read_rig, write_rig
from rgbd_calib.quality import CameraStatistics
from rgbd_calib.types import Rig, RigCamera

COLOR = Intrinsics(640, 480, 550.0, 551.0, 322.0, 238.0, (0.05, -0.1, 0.001, -0.001, 0.0))
DEPTH = Intrinsics(512, 424, 365.0, 365.5, 255.0, 210.0, (0.08, -0.27, 0.0, 0.0, 0.1))
T_COLOR_DEPTH = se3.retract(np.eye(4), np.array([0.01, -0.005, 0.002, -0.052, 0.001, 0.002]))
BIAS = DepthBias((0.004, -0.006, 0.002), 0.5, 4.0, 0.001)


def field(size=(512, 424)):
    rng = np.random.default_rng(1)
    pattern = CellPattern((0, 2), rng.normal(0, 0.0005, (2, 6, 8)), np.diag([1e-8, 1e-9]))
    return PolynomialField(*size, 4, (1.8, 0.1), rng.normal(0, 0.001, n_terms(4) - 1), 0.5, 4.0, None, pattern)


def grid_field():
    u, v, z = np.linspace(0, 511, 9), np.linspace(0, 423, 8), np.linspace(0.5, 4.0, 6)
    pixels = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1)[:, :, None]
    error = field().error_m(np.broadcast_to(pixels, (9, 8, 6, 2)), np.broadcast_to(z, (9, 8, 6)))
    return GridField(u, v, z, error)


def test_legendre_products_are_orthogonal_over_the_image():
    x, w = np.polynomial.legendre.leggauss(12)
    X, Y = np.meshgrid(x, x, indexing="ij")
    T = terms(X, Y, 5)
    gram = np.einsum("ij,ijk,ijl->kl", np.outer(w, w), T, T)
    assert np.allclose(gram, np.diag(np.diag(gram)), atol=1e-13)
    assert T.shape[-1] == n_terms(5) == 21


def test_a_grid_holds_its_values_between_and_beyond_its_nodes():
    own = grid_field()
    at = np.array([[0.0, 0.0], [511.0, 423.0]])
    assert np.allclose(own.error_m(at, np.array([0.5, 4.0])), [own.error[0, 0, 0], own.error[-1, -1, -1]])
    assert np.allclose(
        own.error_m(at + [[-9, -9], [9, 9]], np.array([0.1, 9.0])), own.error_m(at, np.array([0.5, 4.0]))
    )


@pytest.mark.parametrize("own", [None, field(), grid_field()], ids=["none", "polynomial", "grid"])
def test_reports_undo_points(own):
    sensor = DepthSensor(DepthCamera(DEPTH, T_COLOR_DEPTH), BIAS, own)
    rng = np.random.default_rng(2)
    pixels, z_m = rng.uniform([5, 5], [506, 418], (200, 2)), rng.uniform(0.6, 3.5, 200)
    seen, reported = sensor.report(sensor.points(pixels, z_m))
    assert np.abs(seen - pixels).max() < 1e-8
    assert np.abs(reported - z_m).max() < 1e-10


def test_depth_of_the_colour_camera_s_geometry_is_the_default():
    camera = RigCamera(COLOR, np.eye(4), np.zeros((6, 6)), BIAS)
    pixels, z_m = np.array([[10.0, 20.0], [600.0, 400.0]]), np.array([1.0, 2.5])
    assert np.allclose(camera.depth_sensor.points(pixels, z_m), COLOR.unproject(pixels, BIAS.correct(z_m)))


@pytest.mark.parametrize("own", [field(), grid_field()], ids=["polynomial", "grid"])
def test_a_rig_file_keeps_the_depth_sensor(tmp_path, own):
    camera = RigCamera(
        COLOR, np.eye(4), np.zeros((6, 6)), BIAS, CameraStatistics(), own, DepthCamera(DEPTH, T_COLOR_DEPTH, np.eye(10))
    )
    write_rig(tmp_path / "rig.yaml", Rig("C1", {"C1": camera}))
    again = read_rig(tmp_path / "rig.yaml").cameras["C1"]
    rng = np.random.default_rng(3)
    pixels, z_m = rng.uniform([5, 5], [506, 418], (50, 2)), rng.uniform(0.6, 3.5, 50)
    assert np.abs(again.depth_sensor.points(pixels, z_m) - camera.depth_sensor.points(pixels, z_m)).max() < 1e-12
    assert np.array_equal(again.depth_camera.covariance, np.eye(10))
    if isinstance(own, PolynomialField):
        assert np.allclose(again.depth_field.pattern_variance_m2(z_m), own.pattern_variance_m2(z_m), rtol=1e-12)
        assert own.pattern_variance_m2(np.array([2.0])) == pytest.approx(1e-8 + 16 * 1e-9)


def test_a_field_of_the_wrong_length_is_refused(tmp_path):
    wrong = replace(field(), coefficients=np.zeros(3))
    write_rig(
        tmp_path / "rig.yaml",
        Rig("C1", {"C1": RigCamera(COLOR, np.eye(4), np.zeros((6, 6)), None, CameraStatistics(), wrong)}),
    )
    with pytest.raises(ConfigError, match=r"depth_field.*3 coefficients, 14 needed"):
        read_rig(tmp_path / "rig.yaml")

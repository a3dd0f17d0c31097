import numpy as np
import pytest

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import resection, se3


def _scene(seed, n=20, flat=False):
    rng = np.random.default_rng(seed)
    T = se3.retract(np.eye(4), np.concatenate([rng.normal(0, 0.6, 3), [0.1, -0.2, 2.5]]))
    points_m = rng.uniform(-0.6, 0.6, (n, 3))
    if flat:
        points_m[:, 2] = 0
    p = se3.transform(T, points_m)
    return rng, T, points_m, p / p[:, 2:]


@pytest.mark.parametrize("seed", range(10))
def test_dlt_is_exact_without_noise(seed):
    _, T, points_m, rays = _scene(seed, n=6 + seed)
    # a reciprocal condition of 1e-4 or better lets rounding grow to 1e-11 or so
    np.testing.assert_allclose(resection.dlt(points_m, rays), T, atol=1e-9)


def test_dlt_error_is_of_the_size_of_the_noise():
    rng, T, points_m, rays = _scene(3, n=200)
    noisy = rays + np.column_stack([rng.normal(0, 1e-3, (200, 2)), np.zeros(200)])
    xi = se3.difference(resection.dlt(points_m, noisy), T)
    assert np.all(np.abs(xi) < 0.01)  # 1e-3 / sqrt(200) times a geometry of about 10, 10 sigmas


@pytest.mark.parametrize(
    ("spoil", "cause"),
    [
        (lambda x, m: (x[:5], m[:5]), "5 points, 6 needed"),
        (lambda x, m: (x * [1, 1, 0], m), "coplanar"),
        (lambda x, m: (x * [1, 0, 0], m), "collinear"),
        (lambda x, m: (np.where(x == x[0], np.nan, x), m), "not finite"),
    ],
)
def test_dlt_names_the_cause(spoil, cause):
    _, _, points_m, rays = _scene(0)
    with pytest.raises(CalibrationError, match=cause):
        resection.dlt(*spoil(points_m, rays))


@pytest.mark.parametrize("seed", range(10))
def test_homography_pose_gives_the_true_pose_first(seed):
    _, T, points_m, rays = _scene(seed, flat=True)
    poses, rms = resection.homography_pose(points_m[:, :2], rays)
    np.testing.assert_allclose(poses[0], T, atol=1e-6)  # cv2 stops its refinement near 1e-7
    assert np.all(np.diff(rms) >= 0)


def test_homography_pose_names_the_cause():
    _, _, points_m, rays = _scene(0, flat=True)
    with pytest.raises(CalibrationError, match="collinear"):
        resection.homography_pose(points_m[:, :2] * [1, 0], rays)
    with pytest.raises(CalibrationError, match="3 points, 4 needed"):
        resection.homography_pose(points_m[:3, :2], rays[:3])

"""Planes through points: exact where the points are, robust where some are wrong."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rgbd_calib.geometry import plane


def points_on(normal, d, n, rng, spread_m=0.5):
    """Points (n, 3) on the plane normal . p = d."""
    basis = np.linalg.svd(np.asarray(normal)[None])[2][1:]
    return rng.uniform(-spread_m, spread_m, (n, 2)) @ basis + d * np.asarray(normal)


@given(st.integers(0, 10_000), st.integers(5, 50))
def test_fit_is_exact_for_points_on_a_plane(seed, n):
    rng = np.random.default_rng(seed)
    true = rng.normal(size=3)
    true /= np.linalg.norm(true)
    points_m = points_on(true, 1.7, n, rng)
    normal, d = plane.fit(points_m)
    assert np.linalg.norm(normal) == pytest.approx(1)
    assert np.abs(points_m @ normal - d).max() < 1e-12
    assert np.sign(normal @ true) * d == pytest.approx(1.7, abs=1e-9)


def test_fit_error_is_what_the_noise_allows():
    sigma_m, n = 0.003, 400
    errors_m = []
    for seed in range(50):
        rng = np.random.default_rng(seed)
        points_m = points_on([0, 0, 1.0], 2.0, n, rng)
        points_m[:, 2] += rng.normal(0, sigma_m, n)
        normal, d = plane.fit(points_m)
        errors_m.append(d / normal[2] - 2.0)
    # the plane's height at the axis is a mean of 400: sigma / 20, and 50 tries tell sigma to 10 %; 5 sigma of that
    assert np.std(errors_m) == pytest.approx(sigma_m / 20, rel=0.5)


@pytest.mark.parametrize("seed", range(10))
def test_ransac_finds_the_plane_under_40_percent_of_gross_errors(seed):
    rng = np.random.default_rng(seed)
    good = points_on([0.6, 0.0, 0.8], 1.5, 120, rng) + rng.normal(0, 0.001, (120, 3))
    bad = rng.uniform(-1, 3, (80, 3))
    normal, d, inliers = plane.ransac(np.concatenate([good, bad]), 0.005, rng)
    # 200 rounds with 0.6^3 = 0.22 chance each: all miss in 1 of 10^21. Noise is 1 mm, the threshold 5 sigma.
    assert inliers[:120].sum() >= 119
    assert inliers[120:].sum() <= 8  # a slab of 10 mm across a box of 4 m holds about 0.3 % of it
    assert abs(normal @ [0.6, 0.0, 0.8]) > np.cos(np.radians(0.5))
    assert abs(d) == pytest.approx(1.5, abs=0.002)


def test_ransac_is_repeatable_and_takes_a_threshold_for_each_point():
    rng = np.random.default_rng(1)
    points_m = points_on([0, 0, 1.0], 1.0, 50, rng)
    points_m[10, 2] += 0.05
    thresholds_m = np.full(50, 0.01)
    thresholds_m[10] = 0.1
    first = plane.ransac(points_m, thresholds_m, np.random.default_rng(2))
    again = plane.ransac(points_m, thresholds_m, np.random.default_rng(2))
    assert np.array_equal(first[0], again[0]) and first[1] == again[1]
    assert first[2].all()
    assert not plane.ransac(points_m, 0.01, np.random.default_rng(2))[2][10]


def test_collinear_points_have_no_plane():
    points_m = np.outer(np.arange(10.0), [1.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="collinear"):
        plane.ransac(points_m, 0.01, np.random.default_rng(0))

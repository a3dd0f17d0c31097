"""The depth bias: known polynomials within their standard errors, outliers, and data that cannot carry one."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import polynomial
from scipy.stats import norm

from rgbd_calib.cameras.depth_bias import DepthBiasParams, _fit, fit_depth_bias, fit_with_data
from rgbd_calib.errors import CalibrationError

C = np.array([0.012, -0.015, 0.004])


def samples(rng: np.random.Generator, n: int = 400, sigma_m: float | np.ndarray = 0.003) -> tuple[np.ndarray, ...]:
    z_m = rng.uniform(0.6, 3.0, n)
    return z_m, z_m + polynomial.polyval(z_m, C) + rng.normal(0, 1, n) * sigma_m


@pytest.mark.parametrize("seed", range(20))
def test_recovers_known_bias(seed):
    rng = np.random.default_rng(seed)
    sigma_m, c = 0.003, np.array([0.012, -0.015, 0.004])
    z_m = rng.uniform(0.6, 3.0, 400)
    bias = fit_depth_bias(
        z_m,
        z_m + np.polynomial.polynomial.polyval(z_m, c) + rng.normal(0, sigma_m, 400),
        DepthBiasParams(order=2),
        camera="C1",
    )
    grid_m = np.linspace(0.6, 3.0, 7)
    left_m = bias.correct(grid_m) - grid_m - np.polynomial.polynomial.polyval(grid_m, c)
    assert np.all(np.abs(left_m) < 5 * bias.standard_error(grid_m))  # 5 standard errors: 1 failure in 2 million


def test_standard_errors_are_those_of_many_recordings():
    grid_m, z = np.linspace(0.7, 2.9, 5), []
    for seed in range(200):
        bias = fit_depth_bias(*samples(np.random.default_rng(seed), 40), DepthBiasParams(order=2), camera="C1")
        left_m = bias.correct(grid_m) - grid_m - polynomial.polyval(grid_m, C)
        z.append(left_m / bias.standard_error(grid_m))
    # the square of a t with 37 degrees of freedom has mean 1.06 and a standard deviation of 1.6, its mean over 200 one of
    # 0.11; 4 of these
    assert np.all(np.abs(np.mean(np.square(z), axis=0) - 1.06) < 0.45)


@pytest.mark.parametrize("seed", range(10))
def test_given_standard_errors_weigh_the_distances(seed):
    rng = np.random.default_rng(seed)
    z_m = np.sort(rng.uniform(0.6, 3.0, 60))
    sigma_m = 0.0015 * z_m**2
    true_m = z_m + polynomial.polyval(z_m, C) + rng.normal(0, 1, 60) * sigma_m
    bias = fit_depth_bias(z_m, true_m, DepthBiasParams(order=2), camera="C1", sigma_m=sigma_m)
    left_m = bias.correct(z_m) - z_m - polynomial.polyval(z_m, C)
    assert np.all(np.abs(left_m) < 5 * bias.standard_error(z_m))
    # the near end rests on distances of 0.5 to 1 mm: better known than the far end of 13 mm
    assert bias.standard_error(0.7) < bias.standard_error(2.9) / 2


def test_scatter_beyond_the_standard_errors_widens_the_result():
    """A tape read to 4 mm under depths known to 0.1 mm: the error of the curve is the tape's."""
    rng = np.random.default_rng(1)
    z_m, true_m = samples(rng, 30, 0.004)
    bias = fit_depth_bias(z_m, true_m, DepthBiasParams(order=1), camera="C1", sigma_m=np.full(30, 1e-4))
    # at the middle of the range sigma / sqrt(30) = 0.73 mm; tau is known to 1 / sqrt(2 * 28) = 13 %, three of these,
    # and the middle of the data is not that of the range
    assert bias.standard_error(1.8) == pytest.approx(0.004 / np.sqrt(30), rel=0.5)


def test_outliers_are_dropped_and_said():
    rng = np.random.default_rng(2)
    z_m, true_m = samples(rng, 60)
    wrong = rng.choice(60, 8, replace=False)
    true_m[wrong] += rng.choice([-1, 1], 8) * rng.uniform(0.05, 0.3, 8)
    fit = fit_with_data(z_m, true_m, DepthBiasParams(order=2), camera="C1")
    assert set(wrong) <= set(np.flatnonzero(fit.dropped))
    assert fit.dropped.sum() <= len(wrong) + 1
    left_m = fit.bias.correct(z_m) - z_m - polynomial.polyval(z_m, C)
    assert np.all(np.abs(left_m) < 5 * fit.bias.standard_error(z_m))


@pytest.mark.parametrize("order", [1, 2, 3])
def test_chooses_an_order_that_follows_the_curve(order):
    rng = np.random.default_rng(order)
    c = [0.0, 0.01, -0.008, 0.006][: order + 1]
    z_m = np.linspace(0.6, 3.5, 60)
    sigma_m = 0.0005
    bias = fit_depth_bias(z_m, z_m + polynomial.polyval(z_m, c) + rng.normal(0, sigma_m, 60), camera="C1")
    assert len(bias.coefficients) - 1 >= order  # an order less leaves centimetres, of which sigma is a twentieth
    left_m = bias.correct(z_m) - z_m - polynomial.polyval(z_m, c)
    assert np.all(np.abs(left_m) < 5 * bias.standard_error(z_m))


@pytest.mark.parametrize("order", [1, 3])
def test_the_criterion_is_akaikes_with_the_small_sample_correction(order):
    """Its definition: -2 log L at the likeliest curve and sigma, 2 p, and 2 p (p + 1) / (n - p - 1)."""
    rng = np.random.default_rng(order)
    n, p = 9, order + 2
    z_m = np.linspace(0.6, 3.0, n)
    bias_m = polynomial.polyval(z_m, C) + rng.normal(0, 1e-3, n) * z_m**2
    fit = _fit(z_m, z_m + bias_m, order, 2.0)
    left_m = bias_m - polynomial.polyval(z_m, fit.coefficients)
    shape = (z_m / z_m.mean()) ** 2
    sigma_m = shape * np.sqrt(np.mean((left_m / shape) ** 2))
    akaike = -2 * norm.logpdf(left_m, 0, sigma_m).sum() + 2 * p + 2 * p * (p + 1) / (n - p - 1)
    assert fit.criterion == pytest.approx(akaike - n * (1 + np.log(2 * np.pi)), abs=1e-9)


def test_held_outside_the_range_of_the_data():
    z_m = np.linspace(0.8, 2.4, 30)
    bias = fit_depth_bias(z_m, z_m + polynomial.polyval(z_m, C), DepthBiasParams(order=2), camera="C1")
    assert (bias.min_m, bias.max_m) == (0.8, 2.4)
    ends = polynomial.polyval(np.array([0.8, 2.4]), C)
    np.testing.assert_allclose(bias.correct(np.array([0.3, 5.0])) - [0.3, 5.0], ends, atol=1e-9)
    assert bias.outside(np.array([0.79, 0.8, 2.4, 2.41])).tolist() == [True, False, False, True]
    slope = C[1] + 2 * C[2] * 2.4  # not followed beyond the end, where it may also change by 1 % of the depth
    held_m = (5.0 - 2.4) * np.hypot(slope, 0.01)
    assert bias.held_sd_m(np.array([1.0, 5.0])) == pytest.approx([0.0, held_m], rel=1e-6)
    assert bias.standard_error(5.0) == pytest.approx(np.hypot(bias.standard_error(2.4), held_m), rel=1e-6)


@pytest.mark.parametrize("n", [0, 1, 3])
def test_too_few_distances(n):
    z_m = np.linspace(0.8, 2.4, n)
    with pytest.raises(CalibrationError, match=rf"^C3: {n} distance\(s\) for the depth bias, 4 needed. Record"):
        fit_depth_bias(z_m, z_m, DepthBiasParams(order=2), camera="C3")


@pytest.mark.parametrize("sigma_m", [None, np.full(20, 0.001)])
def test_too_short_a_range(sigma_m):
    z_m = np.linspace(1.0, 1.2, 20)
    with pytest.raises(CalibrationError, match=r"^C3: depth seen from 1.00 to 1.20 m, .* needed .* nearer and farther"):
        fit_depth_bias(z_m, z_m, camera="C3", sigma_m=sigma_m)


def test_fewest_distances_give_a_line():
    z_m = np.array([1.0, 2.0, 3.0])
    bias = fit_depth_bias(z_m, z_m * 1.01 + 0.002, camera="C1")
    np.testing.assert_allclose(bias.coefficients, [0.002, 0.01], atol=1e-9)


def test_an_order_of_0_is_an_order():
    """Two distances are enough for an offset and its spread; none is taken for "choose an order"."""
    bias = fit_depth_bias([1.0, 2.0], [1.01, 2.01], DepthBiasParams(order=0), camera="C1")
    assert bias.coefficients == pytest.approx((0.01,))

"""The systematic error of a depth sensor as a polynomial of the depth it reports.

    z_true - z = c0 + c1 z + ... + ck z^k

fitted by weighted least squares. Where each depth has a standard error, the weights are 1 / (error^2 + tau^2), with tau
for what the true distances are off by (R. Paule, J. Mandel, J. Res. NBS 87(5), 1982: the tau at which the weighted
squares are what they should be), and the order is the one with the lowest Akaike criterion. Where it has none, the
noise is sigma ~ z^p (p = 2 for a triangulating sensor, 0 where tape and wall dominate): the small-sample criterion
chooses the order and weighs p = 0, 1, 2; the scatter about the curve gives the noise. Outside the range of the data the
correction is held at the range's end.

References
----------
The paper, section 7 (after Nakazawa et al.). C. Hurvich, C.-L. Tsai, Biometrika 76(2), 1989, for the criterion.
K. Burnham, D. Anderson, Model Selection and Multimodel Inference, 2002, section 4.2, for the weights.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import polynomial

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import DepthBias

MAX_RATIO = 1.25
"""Of true distances over measured ones, and of its inverse: sensors are good to a few per cent, and the smallest mistake of
units is a factor of 2.5."""


@dataclass(frozen=True)
class DepthBiasParams:
    order: int | None = None
    """Degree of the polynomial; None: chosen from 1 ... max_order."""
    max_order: int = 4
    noise_exponent: float | None = None
    """p of sigma ~ z^p, where the depths have no standard errors; None: 0, 1 and 2, each by its likelihood."""
    min_range_ratio: float = 1.25
    """The farthest distance over the nearest: below it, offset and scale cannot be distinguished."""
    outlier_sigmas: float = 5.0
    distance_sd_m: float = 0.002
    """Of a wall's distance that distances.csv gives without `sd_m`: a tape measure."""


@dataclass(frozen=True)
class DepthBiasFit:
    """The data behind a depth bias."""

    bias: DepthBias
    z_m: FloatArray
    z_true_m: FloatArray
    dropped: FloatArray
    """(n,) bool: too far from the curve."""


def fit_depth_bias(
    z_m: FloatArray,
    z_true_m: FloatArray,
    params: DepthBiasParams | None = None,
    *,
    camera: str,
    sigma_m: FloatArray | None = None,
) -> DepthBias:
    """Depth bias of `camera` from reported depths (n,), their standard errors (n,) if known, and true ones (n,), metres.

    Raises
    ------
    CalibrationError
        Fewer data than the polynomial needs, or over too short a range.
    """
    return fit_with_data(z_m, z_true_m, params, camera=camera, sigma_m=sigma_m).bias


def fit_with_data(
    z_m: FloatArray,
    z_true_m: FloatArray,
    params: DepthBiasParams | None = None,
    *,
    camera: str,
    sigma_m: FloatArray | None = None,
) -> DepthBiasFit:
    """The same as :func:`fit_depth_bias`, with the data and what was dropped."""
    params = params or DepthBiasParams()
    z_m, z_true_m = np.asarray(z_m, float), np.asarray(z_true_m, float)
    least = (1 if params.order is None else params.order) + 2
    if len(z_m) < least:
        raise CalibrationError(
            f"{camera}: {len(z_m)} distance(s) for the depth bias, {least} needed. Record the wall at more distances"
        )
    if z_m.max() < params.min_range_ratio * z_m.min():
        raise CalibrationError(
            f"{camera}: depth seen from {z_m.min():.2f} to {z_m.max():.2f} m, a ratio of {params.min_range_ratio} needed "
            "to tell offset from scale. Record it nearer and farther too"
        )
    ratio = float(np.median(z_true_m / z_m))
    if not 1 / MAX_RATIO < ratio < MAX_RATIO:
        raise CalibrationError(
            f"{camera}: true distances are {ratio:.3g} times the measured depth, in the median; {1 / MAX_RATIO:g} to "
            f"{MAX_RATIO:g} needed. Check the unit of the distances (metres) and depth_scale (metres for each unit of depth)"
        )
    keep = np.ones(len(z_m), bool)
    for _ in range(5):
        best = _best(z_m[keep], z_true_m[keep], None if sigma_m is None else sigma_m[keep], params)
        scaled = (z_true_m - z_m - polynomial.polyval(z_m, best.coefficients)) / (
            z_m**best.exponent if sigma_m is None else np.hypot(sigma_m, best.tau_m)
        )
        spread = 1.4826 * float(np.median(np.abs(scaled[keep]))) + 1e-12
        again = np.abs(scaled) <= params.outlier_sigmas * spread
        if np.array_equal(again, keep) or again.sum() < max(least, len(z_m) // 2):
            break
        keep = again
    left_m = (z_true_m - z_m - polynomial.polyval(z_m, best.coefficients))[keep]
    bias = DepthBias(
        tuple(float(c) for c in best.coefficients),
        float(z_m[keep].min()),
        float(z_m[keep].max()),
        float(np.sqrt(np.mean(left_m**2))),
        best.covariance,
    )
    return DepthBiasFit(bias, z_m, z_true_m, ~keep)


@dataclass(frozen=True)
class _Fit:
    coefficients: FloatArray
    covariance: FloatArray
    exponent: float
    tau_m: float
    criterion: float


def _best(z_m: FloatArray, z_true_m: FloatArray, sigma_m: FloatArray | None, params: DepthBiasParams) -> _Fit:
    top = min(params.max_order, len(z_m) - 3)  # at least two degrees of freedom stay for the scatter
    orders = [params.order] if params.order is not None else list(range(1, max(top, 1) + 1))
    if sigma_m is not None:
        tau_m = _tau(z_m, z_true_m, sigma_m, max(orders))
        fits = (_fit_known(z_m, z_true_m, np.hypot(sigma_m, tau_m), order, tau_m) for order in orders)
        return min(fits, key=lambda fit: fit.criterion)
    exponents = [0.0, 1.0, 2.0] if params.noise_exponent is None else [params.noise_exponent]
    listed = [[_fit(z_m, z_true_m, order, p) for p in exponents] for order in orders]
    return _averaged(min(listed, key=lambda fits: min(fit.criterion for fit in fits)))


def _averaged(fits: list[_Fit]) -> _Fit:
    """Fits of one order over the noise exponents that they assume, by Akaike weights.

    The likeliest exponent alone would claim a near end several times as sure as it is, where few distances decide it.
    """
    best = min(fits, key=lambda fit: fit.criterion)
    behind = np.nan_to_num([fit.criterion - best.criterion for fit in fits])  # inf - inf with very few distances
    weights = np.exp(-behind / 2) / np.exp(-behind / 2).sum()
    mean = np.sum([w * fit.coefficients for w, fit in zip(weights, fits, strict=True)], axis=0)
    off = [fit.coefficients - mean for fit in fits]
    covariance = np.sum(
        [w * (fit.covariance + np.outer(d, d)) for w, fit, d in zip(weights, fits, off, strict=True)], axis=0
    )
    return replace(best, coefficients=mean, covariance=covariance)


def _fit(z_m: FloatArray, z_true_m: FloatArray, order: int, exponent: float) -> _Fit:
    n, k = len(z_m), order + 1
    sigma = (z_m / z_m.mean()) ** exponent
    A = polynomial.polyvander(z_m, order) / sigma[:, None]
    y = (z_true_m - z_m) / sigma
    Q, R = np.linalg.qr(A)
    coefficients = np.linalg.solve(R, Q.T @ y)
    sse = float(np.sum((y - A @ coefficients) ** 2)) + 1e-24
    R_inv = np.linalg.inv(R)
    # Gaussian likelihood with sigma estimated: k + 1 parameters, small-sample correction
    p = k + 1
    correction = 2 * p * (p + 1) / (n - p - 1) if n > p + 1 else np.inf if order > 1 else 0.0
    criterion = n * np.log(sse / n) + 2 * float(np.sum(np.log(sigma))) + 2 * p + correction
    return _Fit(coefficients, R_inv @ R_inv.T * sse / max(n - k, 1), exponent, 0.0, criterion)


def _tau(z_m: FloatArray, z_true_m: FloatArray, sigma_m: FloatArray, order: int) -> float:
    """Scatter beyond the standard errors, metres: the one at which chi^2 is its degrees of freedom; 0 if it is less."""
    from scipy.optimize import brentq

    freedom = len(z_m) - order - 1

    def excess(tau_m: float) -> float:
        return _chi2(z_m, z_true_m, np.hypot(sigma_m, tau_m), order)[0] - freedom

    high = float(np.ptp(z_true_m - z_m)) + 1e-6
    return 0.0 if excess(0.0) <= 0 or excess(high) > 0 else float(brentq(excess, 0.0, high))


def _chi2(
    z_m: FloatArray, z_true_m: FloatArray, sigma_m: FloatArray, order: int
) -> tuple[float, FloatArray, FloatArray]:
    """Weighted squares of the fit, its coefficients and their covariance."""
    A = polynomial.polyvander(z_m, order) / sigma_m[:, None]
    y = (z_true_m - z_m) / sigma_m
    R_inv = np.linalg.inv(np.linalg.qr(A, mode="r"))
    covariance = R_inv @ R_inv.T
    coefficients = covariance @ (A.T @ y)
    return float(np.sum((y - A @ coefficients) ** 2)), coefficients, covariance


def _fit_known(z_m: FloatArray, z_true_m: FloatArray, sigma_m: FloatArray, order: int, tau_m: float) -> _Fit:
    chi2, coefficients, covariance = _chi2(z_m, z_true_m, sigma_m, order)
    return _Fit(coefficients, covariance, 0.0, tau_m, chi2 + 2 * (order + 1))

"""What a depth sensor errs by: along the range (a bias), and over the image (a field).

    z_true = z + bias(z) + field(u, v, z)

with z the reported depth and (u, v) the pixel of the depth image. A triangulating sensor errs in disparity, so that its
field grows as z^2; a time-of-flight camera errs in range.

References
----------
D. Herrera, J. Kannala, J. Heikkila, Joint depth and color camera calibration with distortion correction, IEEE PAMI
34(10), 2012. K. Khoshelham, S. Oude Elberink, Sensors 12(2), 2012.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre, polynomial
from scipy.ndimage import map_coordinates

from rgbd_calib.geometry.linear import BoolArray
from rgbd_calib.geometry.so3 import FloatArray

RIPPLE_FROM = 4
"""Degree from which on what the depth errs by along the range is no bias, but goes up and down."""
UNKNOWN_SLOPE = 0.01
"""Change of a bias with depth where nothing was measured, one sigma: devices of all kinds are within some percent."""
ErrorOfDepth = Callable[[FloatArray], FloatArray]
"""True less reported depth, metres, of reported depths at given pixels, both (...)."""


@dataclass(frozen=True)
class DepthBias:
    """z_true = z + c0 + c1 z + c2 z^2 + ... + sum_d r_d P_d(t), z in metres, on [min_m, max_m] and held at the ends outside.

    P_d are Legendre's polynomials of the degrees from RIPPLE_FROM on, t goes from -1 to 1 over the range. Time of flight errs
    along the pixel's ray, (x, y, 1) of length s: all of this is then of s z in place of z, and over s.
    """

    coefficients: tuple[float, ...]
    min_m: float
    max_m: float
    rms_m: float
    covariance: FloatArray | None = None
    """(k, k) of the coefficients, then of the ripple, where it is known."""
    ripple_m: tuple[float, ...] = ()
    """r_d, metres: what goes up and down along the range."""

    along_ray: bool = False
    """It errs in the distance along the pixel's ray, as time of flight does, and not in z."""
    data_m: tuple[float, float] | None = None
    """Range of the data where the curve goes on beyond it; None: that of the curve."""

    @property
    def measured_m(self) -> tuple[float, float]:
        """Range of the data that it rests on."""
        return self.data_m or (self.min_m, self.max_m)

    def error_m(self, z_m: FloatArray, stretch: FloatArray | float = 1.0) -> FloatArray:
        """z_true - z, metres, same shape as `z_m`; `stretch` is the length of the pixels' rays (x, y, 1)."""
        s, r_m = self._along(z_m, stretch)
        out = polynomial.polyval(r_m, np.array(self.coefficients)) / s
        if any(self.ripple_m):
            out = out + self._ripple(s, r_m) @ np.array(self.ripple_m)
        return np.asarray(out)

    def by_parameters(self, z_m: FloatArray, stretch: FloatArray | float = 1.0) -> FloatArray:
        """Derivatives (..., k) of the error by the coefficients, then by the ripple."""
        s, r_m = self._along(z_m, stretch)
        powers = polynomial.polyvander(r_m, len(self.coefficients) - 1) / s[..., None]
        return np.asarray(np.concatenate([powers, self._ripple(s, r_m)], axis=-1) if self.ripple_m else powers)

    def _along(self, z_m: FloatArray, stretch: FloatArray | float) -> tuple[FloatArray, FloatArray]:
        """s, and what the curve is of: s z, held to the range."""
        s = np.asarray(stretch if self.along_ray else 1.0)
        return s, np.clip(z_m * s, self.min_m, self.max_m)

    def _ripple(self, s: FloatArray, r_m: FloatArray) -> FloatArray:
        """(..., k)."""
        t = 2 * (r_m - self.min_m) / (self.max_m - self.min_m) - 1
        return legendre.legvander(t, RIPPLE_FROM + len(self.ripple_m) - 1)[..., RIPPLE_FROM:] / s[..., None]

    def correct(self, z_m: FloatArray, stretch: FloatArray | float = 1.0) -> FloatArray:
        """Depth with the bias removed, metres, same shape as `z_m`."""
        z_m = np.asarray(z_m, float)
        return z_m + self.error_m(z_m, stretch)

    def outside(self, z_m: FloatArray) -> BoolArray:
        """Where reported depths are outside the range of the data; same shape."""
        low_m, high_m = self.measured_m
        return np.asarray((z_m < low_m) | (z_m > high_m))

    def held_sd_m(self, z_m: FloatArray) -> FloatArray:
        """One sigma, metres, same shape, of holding the correction outside [min_m, max_m]; zero inside.

        The distance from the range times the slope at its end, which is not followed, and the unknown change of that slope.
        """
        ends_m = np.clip(z_m, self.min_m, self.max_m)
        slope = polynomial.polyval(ends_m, polynomial.polyder(np.array(self.coefficients)))
        return np.asarray(np.abs(z_m - ends_m) * np.hypot(slope, UNKNOWN_SLOPE))

    def standard_error(self, z_m: FloatArray) -> FloatArray:
        """One sigma of the correction at z_m, metres, same shape; needs the covariance."""
        if self.covariance is None:
            raise ValueError("this depth bias has no covariance")
        V = self.by_parameters(z_m)
        fitted = np.einsum("...i,ij,...j->...", V, self.covariance, V).reshape(np.shape(z_m))
        return np.sqrt(fitted + self.held_sd_m(np.asarray(z_m, float)) ** 2)


def n_terms(degree: int) -> int:
    """Products of two polynomials up to a total degree."""
    return (degree + 1) * (degree + 2) // 2


def terms(x: FloatArray, y: FloatArray, degree: int) -> FloatArray:
    """(..., n_terms) products of Legendre polynomials in x and y, -1 to 1, by total degree from 0 on."""
    X, Y = legendre.legvander(x, degree), legendre.legvander(y, degree)
    pairs = [(i, d - i) for d in range(degree + 1) for i in range(d + 1)]
    return np.stack([X[..., i] * Y[..., j] for i, j in pairs], axis=-1)


def over_image(pixels_px: FloatArray, size_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (..., 2) of images of `size_px` (2,) or (..., 2) as x and y (...), -1 to 1 from border to border, held there."""
    at = np.clip((2 * pixels_px + 1) / size_px - 1, -1, 1)
    return at[..., 0], at[..., 1]


@dataclass(frozen=True)
class CellPattern:
    """Values over the image, linear between the middles of its cells, for each of some powers of the depth."""

    powers: tuple[int, ...]
    values: FloatArray
    """(powers, rows, columns) of cells that fill the image."""
    covariance: FloatArray | None = None
    """(powers, powers) of the values of one cell, the mean over the image, where it is known."""

    def variance_m2(self, z_m: FloatArray) -> FloatArray:
        """Of the pattern at reported depths (...); zero where it is not known."""
        if self.covariance is None:
            return np.zeros(np.shape(z_m))
        V = np.asarray(z_m)[..., None] ** np.array(self.powers, float)
        return np.asarray(np.einsum("...p,pq,...q->...", V, self.covariance, V))

    def error_m(self, pixels_px: FloatArray, z_m: FloatArray, size_px: FloatArray) -> FloatArray:
        """(...), metres, at pixels (..., 2) of an image of `size_px` (2,) and reported depths (...)."""
        return self.at(pixels_px, size_px)(z_m)

    def at(self, pixels_px: FloatArray, size_px: FloatArray) -> ErrorOfDepth:
        """The error at pixels (..., 2) as a function of the reported depths there."""
        _, rows, columns = self.values.shape
        at = (pixels_px + 0.5) / size_px * [columns, rows] - 0.5
        maps = [map_coordinates(values, [at[..., 1], at[..., 0]], order=1, mode="nearest") for values in self.values]

        def error_m(z_m: FloatArray) -> FloatArray:
            out = np.zeros(np.shape(z_m))
            for power, pattern in zip(self.powers, maps, strict=True):
                out += pattern * np.asarray(z_m) ** power
            return out

        return error_m


PIXELS_AT_ONCE = 50_000
"""Whose shapes are in memory together: some 20 MB."""
FIELD_AT_M = 3.0
"""Depth at which a field has its coefficients, unless it says another."""


@dataclass(frozen=True)
class PolynomialField:
    """Legendre polynomials over the image, that grow with the depth.

    field(u, v, z) = (z / z0)^(p + q ln(z / z0)) sum_k c_k T_k(x, y), z0 = at_m

    with z held to [min_m, max_m], degrees from 1 on: the degree 0 is the bias's.
    """

    width: int
    height: int
    degree: int
    growth: tuple[float, float]
    """p, q: 2, 0 of an error in disparity, 0, 0 of one in range."""
    coefficients: FloatArray
    """(n_terms - 1,)."""
    min_m: float
    max_m: float
    covariance: FloatArray | None = None
    """(k, k) of the coefficients, then p and q, where it is known."""
    pattern: CellPattern | None = None
    """What is finer than the polynomials, where walls showed it."""
    at_m: float = FIELD_AT_M
    """Depth at which the coefficients are what it errs by."""

    def error_m(self, pixels_px: FloatArray, z_m: FloatArray) -> FloatArray:
        """field (...), metres, at pixels (..., 2) of the depth image and reported depths (...)."""
        return self.at(pixels_px)(z_m)

    def at(self, pixels_px: FloatArray) -> ErrorOfDepth:
        """The field at pixels (..., 2) as a function of the reported depths there: what does not depend on them, once."""
        flat = pixels_px.reshape(-1, 2)
        parts = [flat[k : k + PIXELS_AT_ONCE] for k in range(0, len(flat), PIXELS_AT_ONCE)]
        smooth = np.concatenate([np.zeros(0), *(self._shapes(part) @ self.coefficients for part in parts)])
        smooth = smooth.reshape(pixels_px.shape[:-1])
        size_px = np.array([self.width, self.height], float)
        fine = None if self.pattern is None else self.pattern.at(pixels_px, size_px)

        def error_m(z_m: FloatArray) -> FloatArray:
            z = np.clip(z_m, self.min_m, self.max_m)
            out = np.asarray(self._grown(z) * smooth)
            return out if fine is None else out + fine(z)

        return error_m

    def pattern_variance_m2(self, z_m: FloatArray) -> FloatArray:
        """(...), of what is finer than the polynomials, at reported depths (...)."""
        z = np.clip(z_m, self.min_m, self.max_m)
        return np.zeros(z.shape) if self.pattern is None else self.pattern.variance_m2(z)

    def by_parameters(self, pixels_px: FloatArray, z_m: FloatArray) -> FloatArray:
        """(..., k) derivatives of the field by its coefficients, then by p and q."""
        z, T = np.clip(z_m, self.min_m, self.max_m)[..., None], self._shapes(pixels_px)
        pattern, log = (T @ self.coefficients)[..., None], np.log(z / self.at_m)
        return np.concatenate([T, pattern * log, pattern * log**2], axis=-1) * self._grown(z)

    def _grown(self, z_m: FloatArray) -> FloatArray:
        p, q = self.growth
        log = np.log(z_m / self.at_m)
        return np.asarray(np.exp((p + q * log) * log))

    def _shapes(self, pixels_px: FloatArray) -> FloatArray:
        x, y = over_image(pixels_px, np.array([self.width, self.height], float))
        return terms(x, y, self.degree)[..., 1:]


@dataclass(frozen=True)
class GridField:
    """Values on a grid over pixel and depth, linear in between and held outside: what a simulation truly has."""

    u_px: FloatArray
    """(a,), ascending."""
    v_px: FloatArray
    """(b,)."""
    z_m: FloatArray
    """(c,)."""
    error: FloatArray
    """(a, b, c), metres."""

    def error_m(self, pixels_px: FloatArray, z_m: FloatArray) -> FloatArray:
        """field (...), metres, at pixels (..., 2) of the depth image and reported depths (...)."""
        return self.at(pixels_px)(z_m)

    def at(self, pixels_px: FloatArray) -> ErrorOfDepth:
        """The field at pixels (..., 2) as a function of the reported depths there."""
        return lambda z_m: self._interpolated(pixels_px, z_m)

    def _interpolated(self, pixels_px: FloatArray, z_m: FloatArray) -> FloatArray:
        from scipy.interpolate import RegularGridInterpolator

        axes = self.u_px, self.v_px, self.z_m
        at = np.concatenate([pixels_px, np.asarray(z_m, float)[..., None]], axis=-1)
        held = np.clip(at, [a[0] for a in axes], [a[-1] for a in axes])
        return np.asarray(RegularGridInterpolator(axes, self.error, bounds_error=False)(held))


DepthField = PolynomialField | GridField

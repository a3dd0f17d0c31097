"""A lens of one model from pixels and the rays that another model gives them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.camera import Intrinsics, LensName, project_jacobian
from rgbd_calib.geometry.so3 import FloatArray

_GRID = 25


@dataclass(frozen=True)
class FittedLens:
    """A lens, and how well it stands for the other model."""

    intrinsics: Intrinsics
    rms_px: float
    max_px: float


def image_grid(width: int, height: int) -> FloatArray:
    """Pixels (n, 2) all over an image, its corners included."""
    u, v = np.meshgrid(np.linspace(0, width - 1, _GRID), np.linspace(0, height - 1, _GRID))
    return np.stack([u.ravel(), v.ravel()], axis=1)


def fit_lens(start: Intrinsics, pixels: FloatArray, directions: FloatArray, n_free: int, keep_K: bool) -> FittedLens:
    """The lens of `start`'s model that puts directions (n, 3) at pixels (n, 2), least squares.

    Parameters
    ----------
    n_free
        So many of its coefficients are free; the others stay as they are.
    keep_K
        Keep the camera matrix.
    """
    from scipy.optimize import least_squares

    free = np.arange(4 if keep_K else 0, 4 + n_free)

    def full(x: FloatArray) -> FloatArray:
        vector = start.vector
        vector[free] = x
        return vector

    def residuals(x: FloatArray) -> FloatArray:
        return np.asarray(project_jacobian(full(x), directions, start.model)[0] - pixels).ravel()

    def jacobian(x: FloatArray) -> FloatArray:
        J = project_jacobian(full(x), directions, start.model)[2]
        return J[..., free].reshape(-1, len(free))

    x = start.vector[free]
    if len(free):
        x = least_squares(residuals, x, jacobian, method="lm", x_scale="jac", xtol=1e-14, ftol=1e-14).x
    off = np.linalg.norm(residuals(x).reshape(-1, 2), axis=1)
    return FittedLens(start.with_vector(full(x)), float(np.sqrt(np.mean(off**2))), float(off.max()))


def as_model(lens: Intrinsics, model: LensName, n: int) -> FittedLens:
    """The lens with the first `n` coefficients of a model, over the lens's whole image.

    Pixels that the lens cannot invert (beyond its fold) are left out.

    Raises
    ------
    ValueError
        The lens inverts no more than half of its image.
    """
    pixels = image_grid(lens.width, lens.height)
    directions = lens.rays(pixels)
    good = np.isfinite(directions).all(axis=1)
    if np.mean(good) <= 0.5:
        raise ValueError(f"the lens can be inverted at {np.mean(good):.0%} of its image only")
    size = 4 if model == "kannala_brandt" else next(own for own in (4, 5, 8, 12, 14) if own >= n)
    k = list(lens.distortion[:n]) if lens.model == model else []
    start = Intrinsics(
        lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy, tuple([*k, *[0.0] * (size - len(k))]), model
    )
    return fit_lens(start, pixels[good], directions[good], n, keep_K=False)

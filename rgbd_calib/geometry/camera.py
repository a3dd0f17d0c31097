"""The camera: a lens model, focal lengths and centre; pixel (0, 0) is the centre of the top left pixel.

    (x_d, y_d) = lens(X / Z, Y / Z)          u = fx x_d + cx          v = fy y_d + cy

This is psi of the paper (eq. 2.2) in the camera's frame. The lens models are :mod:`.brown_conrady` (OpenCV's 4, 5, 8, 12
or 14 coefficients) and :mod:`.kannala_brandt` (OpenCV's fisheye).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from types import ModuleType
from typing import Literal

import numpy as np

from rgbd_calib.geometry import brown_conrady, kannala_brandt
from rgbd_calib.geometry.so3 import FloatArray

LensName = Literal["opencv", "kannala_brandt"]
LENSES: dict[LensName, ModuleType] = {"opencv": brown_conrady, "kannala_brandt": kannala_brandt}
"""Each has SIZES, distort, distort_jacobian and radial."""
LensKind = Literal["brown", "rational", "fisheye"]
LENS_KINDS: tuple[LensKind, ...] = ("brown", "rational", "fisheye")
"""OpenCV's five coefficients, its eight, and the four of its fisheye."""

_NEWTON_STEPS = 50
_CONVERGED = 1e-9
_RADII = np.concatenate([np.linspace(0, 2, 1024)[1:], np.geomspace(2, 60, 512)[1:]])
"""Undistorted radii at which a lens is searched for its fold: up to 89 degrees off the axis."""


@dataclass(frozen=True)
class Intrinsics:
    """Focal lengths and centre in px, distortion without unit, for images of `width` x `height` px."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    model: LensName = "opencv"

    def __post_init__(self) -> None:
        sizes = LENSES[self.model].SIZES
        if len(self.distortion) not in sizes:
            raise ValueError(f"lens {self.model}: {len(self.distortion)} coefficients, {sizes} are possible")

    @property
    def vector(self) -> FloatArray:
        """Parameters (4 + n,): fx, fy, cx, cy, and the lens's n coefficients."""
        return np.array([self.fx, self.fy, self.cx, self.cy, *self.distortion])

    @property
    def K(self) -> FloatArray:
        """Camera matrix (3, 3), px."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def size_px(self) -> FloatArray:
        """(2,): width and height."""
        return np.array([self.width, self.height], float)

    def with_vector(self, vector: FloatArray) -> Intrinsics:
        """The same image size and lens model with other parameters (4 + n,)."""
        fx, fy, cx, cy, *distortion = (float(v) for v in vector)
        return Intrinsics(self.width, self.height, fx, fy, cx, cy, tuple(distortion), self.model)

    def without_distortion(self) -> Intrinsics:
        """The pinhole of the same camera matrix."""
        return replace(self, distortion=(0.0,) * 5, model="opencv")

    def project(self, p_color: FloatArray) -> FloatArray:
        """Pixels (..., 2) of points (..., 3), metres, in the camera's frame; see :func:`project`."""
        return project(self.vector, p_color, self.model)

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Rays (..., 3) with z = 1 of pixels (..., 2); see :func:`rays`."""
        return rays(self.vector, pixels, self.model)

    def unproject(self, pixels: FloatArray, z_m: FloatArray) -> FloatArray:
        """Points (..., 3), metres, in the camera's frame, of pixels (..., 2) at depths z_m (...)."""
        return self.rays(pixels) * np.asarray(z_m)[..., None]


def model_of(kind: LensKind) -> LensName:
    """The lens model of a kind of lens."""
    return "kannala_brandt" if kind == "fisheye" else "opencv"


def project(vector: FloatArray, p_color: FloatArray, model: LensName = "opencv") -> FloatArray:
    """Pixels (..., 2) of points (..., 3), metres, in the camera's frame.

    `vector` is (4 + n,), or (..., 4 + n) with one row for each point. Points behind the camera give numbers without
    meaning: the caller checks Z > 0.
    """
    vector = np.asarray(vector)
    xy_d = LENSES[model].distort(vector[..., 4:], p_color[..., :2] / p_color[..., 2:])
    return np.asarray(vector[..., :2] * xy_d + vector[..., 2:4])


def project_jacobian(
    vector: FloatArray, p_color: FloatArray, model: LensName = "opencv"
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels (..., 2) and their derivatives (..., 2, 3) by the point and (..., 2, 4 + n) by the intrinsics.

    `vector` is (4 + n,) or (..., 4 + n); `p_color` is (..., 3), metres, in the camera's frame.
    """
    vector = np.asarray(vector)
    z_inv = 1.0 / p_color[..., 2:]
    xy = p_color[..., :2] * z_inv
    xy_d, by_xy, by_k = LENSES[model].distort_jacobian(vector[..., 4:], xy)
    f = vector[..., :2]
    J_point = np.empty((*xy.shape[:-1], 2, 3))
    J_point[..., :2] = f[..., None] * by_xy * z_inv[..., None]
    J_point[..., 2] = -(J_point[..., 0] * xy[..., None, 0] + J_point[..., 1] * xy[..., None, 1])
    J_vector = np.zeros((*xy.shape[:-1], 2, vector.shape[-1]))
    J_vector[..., 0, 0], J_vector[..., 1, 1] = xy_d[..., 0], xy_d[..., 1]
    J_vector[..., 0, 2] = J_vector[..., 1, 3] = 1.0
    J_vector[..., 4:] = f[..., None] * by_k
    return f * xy_d + vector[..., 2:4], J_point, J_vector


def rays(vector: FloatArray, pixels: FloatArray, model: LensName = "opencv") -> FloatArray:
    """Rays (..., 3) with z = 1 of pixels (..., 2), `vector` (4 + n,): a point at depth z along the axis is ``z * ray``.

    Newton's method from the inverse of the radial part, which is tabulated up to the radius at which the lens folds back; to
    machine precision wherever the lens can be inverted, and NaN where it cannot (a pixel beyond the fold).
    """
    vector = np.asarray(vector, float)
    lens, k = LENSES[model], vector[4:]
    xy_d = (np.asarray(pixels, float) - vector[2:4]) / vector[:2]
    if not np.any(k):
        return _with_one(xy_d if model == "opencv" else xy_d * _scale(k, xy_d, model)[..., None])
    shape = xy_d.shape
    target = xy_d.reshape(-1, 2)
    out = target * _scale(k, target, model)[:, None]
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            now, by_xy, _ = lens.distort_jacobian(k, out, by_coefficients=False)
            left = now - target
            det = by_xy[..., 0, 0] * by_xy[..., 1, 1] - by_xy[..., 0, 1] * by_xy[..., 1, 0]
            step = (
                np.stack(
                    [
                        by_xy[..., 1, 1] * left[..., 0] - by_xy[..., 0, 1] * left[..., 1],
                        by_xy[..., 0, 0] * left[..., 1] - by_xy[..., 1, 0] * left[..., 0],
                    ],
                    axis=-1,
                )
                / det[..., None]
            )
            out = out - step
            if not np.any(np.abs(step).sum(axis=-1) > 1e-15):
                break
        off = np.abs(lens.distort(k, out) - target).sum(axis=-1)
        # before the fold both eigenvalues are positive; beyond it one is negative, far beyond it both are
        trace = by_xy[..., 0, 0] + by_xy[..., 1, 1]
        good = (off < _CONVERGED) & (det > 0) & (trace > 0)
    found = _with_one(out)
    found[~good] = np.nan
    return found.reshape(*shape[:-1], 3)


def unproject(vector: FloatArray, pixels: FloatArray, z_m: FloatArray, model: LensName = "opencv") -> FloatArray:
    """Points (..., 3), metres, in the camera's frame, of pixels (..., 2) at depths z_m (...)."""
    return rays(vector, pixels, model) * np.asarray(z_m)[..., None]


def fold_radius(distortion: tuple[float, ...], model: LensName) -> float:
    """Undistorted radius, X / Z, at which the radial part of a lens stops growing; inf where it never does."""
    radii, _ = _table(tuple(distortion), model)
    return float("inf") if len(radii) == len(_RADII) + 1 else float(radii[-1])


def _scale(k: FloatArray, xy_d: FloatArray, model: LensName) -> FloatArray:
    """Undistorted over distorted radius (...), by the radial part alone; NaN beyond the fold."""
    radii, distorted = _table(tuple(k.tolist()), model)
    r_d = np.hypot(xy_d[..., 0], xy_d[..., 1])
    # a little beyond the fold the tangential part may still bring a pixel back
    r = np.where(r_d > 1.02 * distorted[-1], np.nan, np.interp(r_d, distorted, radii))
    return np.where(r_d > 1e-12, r / np.maximum(r_d, 1e-12), 1.0)


@lru_cache(maxsize=256)
def _table(distortion: tuple[float, ...], model: LensName) -> tuple[FloatArray, FloatArray]:
    """Undistorted radii and the distorted ones, from the axis to where they no longer grow."""
    with np.errstate(all="ignore"):
        distorted = LENSES[model].radial(np.array(distortion), _RADII)
    grows = np.diff(np.concatenate([[0.0], distorted])) > 0
    n = len(_RADII) if grows.all() else int(np.argmin(grows))
    return np.concatenate([[0.0], _RADII[:n]]), np.concatenate([[0.0], distorted[:n]])


def _with_one(xy: FloatArray) -> FloatArray:
    return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)

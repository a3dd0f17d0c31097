"""The pinhole camera with Brown-Conrady distortion, OpenCV's order k1, k2, p1, p2, k3.

With (x, y) = (X / Z, Y / Z), r2 = x^2 + y^2, g = 1 + k1 r2 + k2 r2^2 + k3 r2^3:

    x_d = x g + 2 p1 x y + p2 (r2 + 2 x^2)          u = fx x_d + cx
    y_d = y g + p1 (r2 + 2 y^2) + 2 p2 x y          v = fy y_d + cy

Pixel (0, 0) is the centre of the top left pixel. This is psi of the paper (eq. 2.2) in the camera's frame.

References
----------
D. C. Brown, Close-range camera calibration, Photogrammetric Engineering 37(8), 1971.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray

N_INTRINSICS = 9
"""Length of the parameter vector fx, fy, cx, cy, k1, k2, p1, p2, k3."""

_UNDISTORT_STEPS = 20


@dataclass(frozen=True)
class Intrinsics:
    """Focal lengths and centre in px, distortion without unit, for images of `width` x `height` px."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def vector(self) -> FloatArray:
        """Parameters (9,): fx, fy, cx, cy, k1, k2, p1, p2, k3."""
        return np.array([self.fx, self.fy, self.cx, self.cy, *self.distortion])

    @property
    def K(self) -> FloatArray:
        """Camera matrix (3, 3), px."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def with_vector(self, vector: FloatArray) -> Intrinsics:
        """The same image size with other parameters (9,)."""
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = (float(v) for v in vector)
        return Intrinsics(self.width, self.height, fx, fy, cx, cy, (k1, k2, p1, p2, k3))


def project(vector: FloatArray, p_color: FloatArray) -> FloatArray:
    """Pixels (..., 2) of points (..., 3), metres, in the colour camera's frame.

    `vector` is (9,), or (..., 9) with one row for each point. Points behind the camera give numbers without
    meaning: the caller checks Z > 0.
    """
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = np.moveaxis(np.asarray(vector), -1, 0)
    x, y = p_color[..., 0] / p_color[..., 2], p_color[..., 1] / p_color[..., 2]
    x_d, y_d = _distort(x, y, k1, k2, p1, p2, k3)
    return np.stack([fx * x_d + cx, fy * y_d + cy], axis=-1)


def project_jacobian(vector: FloatArray, p_color: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels (n, 2) and their derivatives (n, 2, 3) by the point and (n, 2, 9) by the intrinsics.

    `vector` is (9,) or (n, 9); `p_color` is (n, 3), metres, in the colour camera's frame.
    """
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = np.moveaxis(np.asarray(vector), -1, 0)
    z_inv = 1.0 / p_color[..., 2]
    x, y = p_color[..., 0] * z_inv, p_color[..., 1] * z_inv
    r2 = x * x + y * y
    g = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    dg = k1 + r2 * (2 * k2 + 3 * r2 * k3)  # dg / d r2
    x_d = x * g + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    y_d = y * g + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    pixels = np.stack([fx * x_d + cx, fy * y_d + cy], axis=-1)

    # by (x, y); the off-diagonal terms of the lens are equal
    xx = g + 2 * x * x * dg + 2 * p1 * y + 6 * p2 * x
    yy = g + 2 * y * y * dg + 6 * p1 * y + 2 * p2 * x
    xy = 2 * x * y * dg + 2 * p1 * x + 2 * p2 * y
    J_point = np.empty((*x.shape, 2, 3))
    J_point[..., 0, 0], J_point[..., 0, 1] = fx * xx * z_inv, fx * xy * z_inv
    J_point[..., 1, 0], J_point[..., 1, 1] = fy * xy * z_inv, fy * yy * z_inv
    J_point[..., 2] = -(J_point[..., 0] * x[..., None] + J_point[..., 1] * y[..., None])

    J_vector = np.zeros((*x.shape, 2, N_INTRINSICS))
    J_vector[..., 0, 0], J_vector[..., 1, 1] = x_d, y_d
    J_vector[..., 0, 2] = J_vector[..., 1, 3] = 1.0
    for column, power in ((4, r2), (5, r2 * r2), (8, r2 * r2 * r2)):
        J_vector[..., 0, column], J_vector[..., 1, column] = fx * x * power, fy * y * power
    J_vector[..., 0, 6], J_vector[..., 1, 6] = fx * 2 * x * y, fy * (r2 + 2 * y * y)
    J_vector[..., 0, 7], J_vector[..., 1, 7] = fx * (r2 + 2 * x * x), fy * 2 * x * y
    return pixels, J_point, J_vector


def rays(vector: FloatArray, pixels: FloatArray) -> FloatArray:
    """Rays (..., 3) with z = 1 of pixels (..., 2): a point at depth z along the axis is ``z * ray``.

    Newton's method on the distortion, to machine precision wherever the lens model can be inverted; NaN where
    it cannot (a pixel beyond the model's turning point).
    """
    vector = np.asarray(vector)
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = np.moveaxis(vector, -1, 0)
    x_d, y_d = (pixels[..., 0] - cx) / fx, (pixels[..., 1] - cy) / fy
    x, y = np.array(x_d, float), np.array(y_d, float)
    with np.errstate(all="ignore"):
        for _ in range(_UNDISTORT_STEPS):
            r2 = x * x + y * y
            g = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            dg = k1 + r2 * (2 * k2 + 3 * r2 * k3)
            rx = x * g + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - x_d
            ry = y * g + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - y_d
            xx = g + 2 * x * x * dg + 2 * p1 * y + 6 * p2 * x
            yy = g + 2 * y * y * dg + 6 * p1 * y + 2 * p2 * x
            xy = 2 * x * y * dg + 2 * p1 * x + 2 * p2 * y
            det = xx * yy - xy * xy
            step_x, step_y = (yy * rx - xy * ry) / det, (xx * ry - xy * rx) / det
            x, y = x - step_x, y - step_y
            if not np.any(np.abs(step_x) + np.abs(step_y) > 1e-15):
                break
        u_d, v_d = _distort(x, y, k1, k2, p1, p2, k3)
        # both eigenvalues positive; beyond a turning point one is negative, far beyond it both are
        bad = ~((np.abs(u_d - x_d) + np.abs(v_d - y_d) < 1e-9) & (det > 0) & (xx + yy > 0))
    out = np.stack([x, y, np.ones_like(x)], axis=-1)
    out[bad] = np.nan
    return out


def unproject(vector: FloatArray, pixels: FloatArray, z_m: FloatArray) -> FloatArray:
    """Points (..., 3), metres, in the colour camera's frame, of pixels (..., 2) at depths z_m (...)."""
    return rays(vector, pixels) * np.asarray(z_m)[..., None]


def _distort(x: Any, y: Any, k1: Any, k2: Any, p1: Any, p2: Any, k3: Any) -> tuple[Any, Any]:
    r2 = x * x + y * y
    g = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return x * g + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * g + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y

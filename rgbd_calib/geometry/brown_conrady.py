"""OpenCV's lens of 4, 5, 8, 12 or 14 coefficients: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]].

With (x, y) = (X / Z, Y / Z), r2 = x^2 + y^2, g = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3):

    x_d = x g + 2 p1 x y + p2 (r2 + 2 x^2) + s1 r2 + s2 r2^2
    y_d = y g + p1 (r2 + 2 y^2) + 2 p2 x y + s3 r2 + s4 r2^2

and with a sensor that is tilted by tau the point (x_d, y_d, 1) is multiplied by the homography of :func:`_tilt`.

References
----------
D. C. Brown, Close-range camera calibration, Photogrammetric Engineering 37(8), 1971. The rational form: D. Claus,
A. Fitzgibbon, CVPR 2005. Thin prism: J. Weng et al., IEEE PAMI 14(10), 1992. Tilt: OpenCV, calib3d.
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray

SIZES = (4, 5, 8, 12, 14)
"""Lengths that the coefficients may have."""


def distort(k: FloatArray, xy: FloatArray) -> FloatArray:
    """Distorted coordinates (..., 2) of undistorted ones (..., 2); `k` (n,) or (..., n), a row for each point."""
    x, y = xy[..., 0], xy[..., 1]
    c = np.moveaxis(np.asarray(k), -1, 0)
    r2 = x * x + y * y
    g, _ = _radial(c, r2)
    x_d = x * g + 2 * c[2] * x * y + c[3] * (r2 + 2 * x * x)
    y_d = y * g + c[2] * (r2 + 2 * y * y) + 2 * c[3] * x * y
    if len(c) > 8:
        x_d, y_d = x_d + r2 * (c[8] + r2 * c[9]), y_d + r2 * (c[10] + r2 * c[11])
    out = np.stack([x_d, y_d], axis=-1)
    return out if len(c) <= 12 else _homography(_tilt(c[12], c[13])[0], out)


def distort_jacobian(
    k: FloatArray, xy: FloatArray, by_coefficients: bool = True
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distorted coordinates (..., 2), and their derivatives (..., 2, 2) by the undistorted and (..., 2, n) by `k`.

    Without `by_coefficients` the last is empty, (..., 2, 0).
    """
    x, y = xy[..., 0], xy[..., 1]
    c = np.moveaxis(np.asarray(k), -1, 0)
    r2 = x * x + y * y
    g, dg = _radial(c, r2)
    x_d = x * g + 2 * c[2] * x * y + c[3] * (r2 + 2 * x * x)
    y_d = y * g + c[2] * (r2 + 2 * y * y) + 2 * c[3] * x * y
    by_xy = np.empty((*x.shape, 2, 2))
    by_xy[..., 0, 0] = g + 2 * x * x * dg + 2 * c[2] * y + 6 * c[3] * x
    by_xy[..., 1, 1] = g + 2 * y * y * dg + 6 * c[2] * y + 2 * c[3] * x
    by_xy[..., 0, 1] = by_xy[..., 1, 0] = 2 * x * y * dg + 2 * c[2] * x + 2 * c[3] * y
    if len(c) > 8:
        x_d, y_d = x_d + r2 * (c[8] + r2 * c[9]), y_d + r2 * (c[10] + r2 * c[11])
        along_x, along_y = 2 * (c[8] + 2 * r2 * c[9]), 2 * (c[10] + 2 * r2 * c[11])
        by_xy[..., 0, 0] += along_x * x
        by_xy[..., 0, 1] += along_x * y
        by_xy[..., 1, 0] += along_y * x
        by_xy[..., 1, 1] += along_y * y
    out = np.stack([x_d, y_d], axis=-1)
    by_k = _by_coefficients(c, x, y, r2, g) if by_coefficients else np.zeros((*x.shape, 2, 0))
    if len(c) <= 12:
        return out, by_xy, by_k
    H, *dH = _tilt(c[12], c[13])
    p, homogeneous = _homography(H, out), np.concatenate([out, np.ones((*x.shape, 1))], axis=-1)
    w = np.einsum("...j,...j->...", H[..., 2, :], homogeneous)[..., None]
    by_out = (H[..., :2, :2] - p[..., None] * H[..., None, 2, :2]) / w[..., None]
    by_k = by_out @ by_k
    for column, derivative in zip((12, 13), dH, strict=True) if by_coefficients else ():
        moved = np.einsum("...ij,...j->...i", derivative, homogeneous)
        by_k[..., column] = (moved[..., :2] - p * moved[..., 2:]) / w
    return p, by_out @ by_xy, by_k


def radial(k: FloatArray, r: FloatArray) -> FloatArray:
    """Distorted radius (m,) of undistorted radii (m,) by the radial coefficients alone."""
    return r * _radial(np.asarray(k, float), r * r)[0]


def _radial(c: FloatArray, r2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """g and dg / d r2."""
    k3 = c[4] if len(c) > 4 else 0.0
    above, d_above = 1 + r2 * (c[0] + r2 * (c[1] + r2 * k3)), c[0] + r2 * (2 * c[1] + 3 * r2 * k3)
    if len(c) <= 5:
        return above, d_above
    below, d_below = 1 + r2 * (c[5] + r2 * (c[6] + r2 * c[7])), c[5] + r2 * (2 * c[6] + 3 * r2 * c[7])
    g = above / below
    return g, (d_above - g * d_below) / below


def _tilt(tau_x: FloatArray, tau_y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The homography (..., 3, 3) of a tilted sensor, and its derivatives by tau_x and tau_y."""

    def of(x: FloatArray, dx: FloatArray, y: FloatArray, dy: FloatArray) -> tuple[FloatArray, FloatArray]:
        Rx, Ry = _zeros(x), _zeros(y)
        Rx[..., 1, 1], Rx[..., 1, 2], Rx[..., 2, 1], Rx[..., 2, 2] = x, dx, -dx, x
        Ry[..., 0, 0], Ry[..., 0, 2], Ry[..., 2, 0], Ry[..., 2, 2] = y, -dy, dy, y
        return Rx, Ry

    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    Rx, Ry = of(cx, sx, cy, sy)
    dRx, dRy = of(-sx, cx, -sy, cy)
    Rx[..., 0, 0], Ry[..., 1, 1] = 1.0, 1.0
    R = Ry @ Rx
    P = _projection(R)
    P[..., 2, 2] = 1.0
    by_x, by_y = Ry @ dRx, dRy @ Rx
    return P @ R, _projection(by_x) @ R + P @ by_x, _projection(by_y) @ R + P @ by_y


def _projection(R: FloatArray) -> FloatArray:
    P = np.zeros_like(R)
    P[..., 0, 0] = P[..., 1, 1] = R[..., 2, 2]
    P[..., 0, 2], P[..., 1, 2] = -R[..., 0, 2], -R[..., 1, 2]
    return P


def _zeros(like: FloatArray) -> FloatArray:
    return np.zeros((*np.shape(like), 3, 3))


def _homography(H: FloatArray, xy: FloatArray) -> FloatArray:
    p = np.einsum("...ij,...j->...i", H[..., :, :2], xy) + H[..., :, 2]
    return np.asarray(p[..., :2] / p[..., 2:])


def _by_coefficients(c: FloatArray, x: FloatArray, y: FloatArray, r2: FloatArray, g: FloatArray) -> FloatArray:
    """(..., 2, n), but for the tilt, of the point before it."""
    by_k = np.zeros((*x.shape, 2, len(c)))
    below = 1.0 if len(c) <= 5 else 1 + r2 * (c[5] + r2 * (c[6] + r2 * c[7]))
    for column, power in ((0, 1), (1, 2), (4, 3))[: 2 + (len(c) > 4)]:
        by_k[..., 0, column], by_k[..., 1, column] = x * r2**power / below, y * r2**power / below
    by_k[..., 0, 2], by_k[..., 1, 2] = 2 * x * y, r2 + 2 * y * y
    by_k[..., 0, 3], by_k[..., 1, 3] = r2 + 2 * x * x, 2 * x * y
    for column, power in ((5, 1), (6, 2), (7, 3)) if len(c) > 5 else ():
        by_k[..., 0, column], by_k[..., 1, column] = -x * g * r2**power / below, -y * g * r2**power / below
    for column, axis, power in ((8, 0, 1), (9, 0, 2), (10, 1, 1), (11, 1, 2)) if len(c) > 8 else ():
        by_k[..., axis, column] = r2**power
    return by_k

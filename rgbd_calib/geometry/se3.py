"""Rigid motions as 4x4 matrices, perturbed from the left (see the package's conventions)."""

import numpy as np

from rgbd_calib.geometry import so3
from rgbd_calib.geometry.so3 import FloatArray


def make(R_a_b: FloatArray, t_a_b: FloatArray) -> FloatArray:
    """T_a_b (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3), metres."""
    T = np.zeros((*np.shape(t_a_b)[:-1], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R_a_b, t_a_b, 1.0
    return T


def inverse(T_a_b: FloatArray) -> FloatArray:
    """T_b_a (..., 4, 4) of T_a_b (..., 4, 4)."""
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    return make(R_b_a, -np.einsum("...ij,...j->...i", R_b_a, T_a_b[..., :3, 3]))


def transform(T_a_b: FloatArray, p_b: FloatArray) -> FloatArray:
    """Points in frame a, (n, 3), of points p_b (n, 3); T_a_b is (4, 4), or (n, 4, 4), one for each point."""
    return np.einsum("...ij,...j->...i", T_a_b[..., :3, :3], p_b) + T_a_b[..., :3, 3]


def retract(T_a_b: FloatArray, xi: FloatArray) -> FloatArray:
    """[Exp(phi), rho; 0, 1] @ T_a_b for xi = (phi in rad, rho in m), (..., 6), in frame a."""
    xi = np.asarray(xi, float)
    return make(so3.exp(xi[..., :3]), xi[..., 3:]) @ T_a_b


def by_motion(p: FloatArray) -> FloatArray:
    """Derivative (..., 3, 6) of Exp(phi) p + rho by (phi in rad, rho in m) at zero, of points (..., 3)."""
    return np.concatenate([-so3.hat(p), np.broadcast_to(np.eye(3), (*p.shape, 3))], axis=-1)


def difference(T_a_c: FloatArray, T_a_b: FloatArray) -> FloatArray:
    """xi (..., 6) with ``retract(T_a_b, xi) == T_a_c``, the inverse of :func:`retract`."""
    D = T_a_c @ inverse(T_a_b)
    return np.concatenate([so3.log(D[..., :3, :3]), D[..., :3, 3]], axis=-1)


def moved(T_before: FloatArray, T_after: FloatArray) -> tuple[float, float]:
    """Length, metres, and angle, radians, of the motion between two poses (4, 4)."""
    step = inverse(T_before) @ T_after
    return float(np.linalg.norm(step[:3, 3])), float(so3.angle_rad(step[:3, :3]))


def adjoint(T_a_b: FloatArray) -> FloatArray:
    """Matrix (6, 6) that carries a small left perturbation (phi, rho) of frame b into frame a."""
    R = T_a_b[:3, :3]
    Ad = np.zeros((6, 6))
    Ad[:3, :3] = Ad[3:, 3:] = R
    Ad[3:, :3] = so3.hat(T_a_b[:3, 3]) @ R
    return Ad

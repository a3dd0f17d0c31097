"""A rigid motion over time: a uniform cumulative cubic B-spline, with its velocity and its derivatives by the knots.

With u = (t - t_k) / h in [0, 1), knots k ... k + 3, and the cumulative basis

    l1 = (5 + 3 u - 3 u^2 + u^3) / 6        l2 = (1 + 3 u + 3 u^2 - 2 u^3) / 6        l3 = u^3 / 6

the rotation is R(t) = R_0 Exp(l1 d_1) Exp(l2 d_2) Exp(l3 d_3), d_j = Log(R_{j-1}' R_j) (Sommer et al., eq. 4), and a point of
the body, here the middle of the board, moves on c(t) = c_0 + l1 (c_1 - c_0) + l2 (c_2 - c_1) + l3 (c_3 - c_2).

The pose is split into SO(3) x R^3 rather than taken as one element of SE(3): on SE(3) the path of a point between two knots
is a screw, so that a turn would bend the path of the hand that carries it; Ovren and Forssen measured the split to be the
better model, and it is the cheaper one. Which point is taken matters then: the middle of the board is what a hand carries,
while its corner (0, 0), the origin of its frame, swings around it.

Perturbations are from the left, as everywhere: R_k <- Exp(phi_k) R_k, c_k <- c_k + gamma_k. With A_j = Exp(l_j d_j),
P_j = R_0 A_1 ... A_j and e_j = phi_j - phi_{j-1}, d_j <- d_j + Jr^-1(d_j) R_j' e_j and A_j <- A_j Exp(l_j Jr(l_j d_j) ...), so that

    phi = phi_0 + sum_j M_j e_j,     M_j = l_j P_j Jr(l_j d_j) Jr^-1(d_j) R_j'          (Sommer et al., eq. 42-46, from the left)
    omega = sum_j l_j' P_j d_j       alpha = sum_j (l_j'' P_j d_j + l_j' omega_{j-1} x P_j d_j),   omega_j = sum_{i <= j}

A left motion of all points of the parent's frame, p <- Exp(phi) p + rho, that turns the body about its middle by phi and moves
it by gamma has rho = gamma - phi x c, so that the derivative by a knot is the 6 x 6 matrix [[M, 0], [hat(c) M, b 1]].

References
----------
C. Sommer, V. Usenko, D. Schubert, N. Demmel, D. Cremers, Efficient derivative computation for cumulative B-splines on Lie
groups, CVPR 2020. H. Ovren, P.-E. Forssen, Trajectory representation and landmark projection for continuous-time structure
from motion, IJRR 38(6), 2019. P. Furgale, T. Barfoot, G. Sibley, Continuous-time batch estimation using temporal basis
functions, ICRA 2012.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.linear import IntArray
from rgbd_calib.geometry.so3 import FloatArray

N_KNOTS = 4
"""Knots that a cubic piece depends on: a window."""
_BASIS = np.array([[5.0, 3, -3, 1], [1, 3, 3, -2], [0, 0, 0, 1]]) / 6
"""Coefficients of u^0 ... u^3 of l1, l2, l3."""
_SMALL = 1e-4
"""Rad: below, the Jacobians' series of two terms is exact to 1e-16."""


@dataclass(frozen=True)
class Spline:
    """K knots at t0_s, t0_s + step_s, ...; times from t0_s + step_s to t0_s + (K - 2) step_s have four knots."""

    t0_s: float
    step_s: float
    R: FloatArray
    """(K, 3, 3)."""
    c_m: FloatArray
    """(K, 3), of the middle."""
    middle_m: FloatArray
    """(3,), in the body's frame."""

    @property
    def n_windows(self) -> int:
        return len(self.R) - N_KNOTS + 1

    def windows(self, t_s: FloatArray) -> tuple[IntArray, FloatArray]:
        """Number (n,) of the window of each time, and u (n,); times outside take the nearest window."""
        x = (np.asarray(t_s) - self.t0_s) / self.step_s - 1
        window = np.clip(np.floor(x).astype(int), 0, self.n_windows - 1)
        return window, x - window

    def moved(self, step: FloatArray) -> Spline:
        """After a step (K, 6) of the knots: (phi, gamma) each."""
        return replace(self, R=so3.exp(step[:, :3]) @ self.R, c_m=self.c_m + step[:, 3:])

    @property
    def turns(self) -> FloatArray:
        """d (K - 1, 3), rad."""
        return so3.log(self.R[:-1].transpose(0, 2, 1) @ self.R[1:])

    def at(self, t_s: FloatArray, window: IntArray | None = None) -> Place:
        """Pose and derivatives at times (n,); on the pieces of windows (n,), continued, where they are given."""
        own, u = self.windows(t_s)
        u = u if window is None else u + (own - window)
        window = own if window is None else window
        power = np.stack([np.ones_like(u), u, u**2, u**3], axis=-1)
        by_u = np.stack([np.zeros_like(u), np.ones_like(u), 2 * u, 3 * u**2], axis=-1) / self.step_s
        by_uu = np.stack([np.zeros_like(u), np.zeros_like(u), np.full_like(u, 2.0), 6 * u], axis=-1) / self.step_s**2
        basis = np.stack([power @ _BASIS.T, by_u @ _BASIS.T, by_uu @ _BASIS.T])  # (3, n, 3)
        d = self.turns[window[:, None] + np.arange(3)]  # (n, 3, 3)
        dc = np.diff(self.c_m[window[:, None] + np.arange(N_KNOTS)], axis=1)
        c, c1, c2 = np.einsum("knj,nji->kni", basis, dc)
        c = c + self.c_m[window]
        P = self.R[window]
        omega, alpha = np.zeros((len(u), 3)), np.zeros((len(u), 3))
        M = []
        l0, l1, l2 = basis
        for j in range(3):
            P = P @ so3.exp(l0[:, j, None] * d[:, j])
            along = np.einsum("nik,nk->ni", P, d[:, j])
            alpha = alpha + l2[:, j, None] * along + l1[:, j, None] * np.cross(omega, along)
            omega = omega + l1[:, j, None] * along
            J = right_jacobian(l0[:, j, None] * d[:, j]) @ inverse_right_jacobian(d[:, j])
            M.append(l0[:, j, None, None] * P @ J @ self.R[window + j + 1].transpose(0, 2, 1))
        return Place(window, P, c, omega, alpha, c1, c2, np.stack(M, axis=1), l0, self.middle_m)

    def jerks(self) -> tuple[FloatArray, FloatArray]:
        """Third differences of the knots of each window (windows, 6), and their derivatives (windows, 6, 24) by its knots.

        (d_1 - 2 d_2 + d_3, c_3 - 3 c_2 + 3 c_1 - c_0): h^3 times the jerk, constant over a cubic piece.
        """
        d, n = self.turns, self.n_windows
        first = np.arange(n)
        c = self.c_m[first[:, None] + np.arange(N_KNOTS)]
        turn = d[first] - 2 * d[first + 1] + d[first + 2]
        r = np.concatenate([turn, c[:, 3] - 3 * c[:, 2] + 3 * c[:, 1] - c[:, 0]], axis=1)
        J = np.zeros((n, 6, N_KNOTS, 6))
        by_later = inverse_right_jacobian(d) @ self.R[1:].transpose(0, 2, 1)
        for j, weight in enumerate((1.0, -2.0, 1.0)):
            J[:, :3, j + 1, :3] += weight * by_later[first + j]
            J[:, :3, j, :3] -= weight * by_later[first + j]
        for k, weight in enumerate((-1.0, 3.0, -3.0, 1.0)):
            J[:, 3:, k, 3:] = weight * np.eye(3)
        return r, J.reshape(n, 6, 6 * N_KNOTS)


@dataclass(frozen=True)
class Place:
    """The spline at n times."""

    window: IntArray
    """(n,), the first of the four knots."""
    R: FloatArray
    """(n, 3, 3)."""
    c_m: FloatArray
    """(n, 3)."""
    omega: FloatArray
    """(n, 3), rad/s, in the parent's frame; its derivative is `alpha`."""
    alpha: FloatArray
    velocity: FloatArray
    """(n, 3), m/s, of the middle; its derivative is `acceleration`."""
    acceleration: FloatArray
    M: FloatArray
    """(n, 3, 3, 3)."""
    basis: FloatArray
    """(n, 3), l1, l2, l3."""
    middle_m: FloatArray

    @property
    def T(self) -> FloatArray:
        """T_parent_body (n, 4, 4)."""
        return se3.make(self.R, self.c_m - self.R @ self.middle_m)

    @property
    def twist(self) -> FloatArray:
        """(n, 6): phi (rad/s) and rho (m/s) of the left motion of all points."""
        return np.concatenate([self.omega, self.velocity - np.cross(self.omega, self.c_m)], axis=-1)

    def by_knots(self) -> FloatArray:
        """Derivative (n, 6, 24) of the left motion of all points by the steps of the window's knots."""
        n = len(self.R)
        turn = np.stack(
            [np.eye(3) - self.M[:, 0], self.M[:, 0] - self.M[:, 1], self.M[:, 1] - self.M[:, 2], self.M[:, 2]], 1
        )
        l1, l2, l3 = self.basis.T
        share = np.stack([1 - l1, l1 - l2, l2 - l3, l3], axis=1)
        out = np.zeros((n, 6, N_KNOTS, 6))
        out[:, :3, :, :3] = turn.transpose(0, 2, 1, 3)
        out[:, 3:, :, :3] = np.einsum("nij,nkjl->nikl", so3.hat(self.c_m), turn)
        out[:, 3:, :, 3:] = np.einsum("nk,ij->nikj", share, np.eye(3))
        return out.reshape(n, 6, 6 * N_KNOTS)


def right_jacobian(v: FloatArray) -> FloatArray:
    """Jr (..., 3, 3): Exp(v + dv) = Exp(v) Exp(Jr dv)."""
    a = np.linalg.norm(v, axis=-1)[..., None, None]
    safe = np.where(a < _SMALL, 1.0, a)
    first = np.where(a < _SMALL, 0.5 - a**2 / 24, (1 - np.cos(safe)) / safe**2)
    second = np.where(a < _SMALL, 1 / 6 - a**2 / 120, (safe - np.sin(safe)) / safe**3)
    V = so3.hat(v)
    return np.asarray(np.eye(3) - first * V + second * V @ V)


def inverse_right_jacobian(v: FloatArray) -> FloatArray:
    """Jr^-1 (..., 3, 3), of turns below half a turn."""
    a = np.linalg.norm(v, axis=-1)[..., None, None]
    safe = np.where(a < _SMALL, 1.0, a)
    second = np.where(a < _SMALL, 1 / 12 + a**2 / 720, 1 / safe**2 - (1 + np.cos(safe)) / (2 * safe * np.sin(safe)))
    V = so3.hat(v)
    return np.asarray(np.eye(3) + 0.5 * V + second * V @ V)


def through(t_s: FloatArray, T: FloatArray, middle_m: FloatArray, step_s: float) -> Spline:
    """A spline near poses T (n, 4, 4) at times (n,), ascending: its knots stand on the poses, interpolated."""
    t_s, first = np.unique(t_s, return_index=True)
    T = T[first]
    t0 = float(t_s[0]) - 2 * step_s
    K = int(np.ceil((t_s[-1] - t0) / step_s)) + 3
    t = np.clip(t0 + step_s * np.arange(K), t_s[0], t_s[-1])
    after = np.clip(np.searchsorted(t_s, t), 1, max(len(t_s) - 1, 1)) if len(t_s) > 1 else np.zeros(K, int)
    before = np.maximum(after - 1, 0)
    share = np.clip((t - t_s[before]) / np.maximum(t_s[after] - t_s[before], 1e-12), 0.0, 1.0)
    c = T[:, :3, :3] @ middle_m + T[:, :3, 3]
    turn = so3.log(T[before, :3, :3].transpose(0, 2, 1) @ T[after, :3, :3])
    R = T[before, :3, :3] @ so3.exp(share[:, None] * turn)
    return Spline(t0, step_s, R, c[before] + share[:, None] * (c[after] - c[before]), middle_m)

"""The 3D term through second moments: one pass over the points, then each iteration costs O(N^2), whatever J is.

With y_l = R_l p_l + t_l and k cameras that see a point, its share of the likelihood is a quadratic form that no common
shift of the y_l changes,

    sum_l |y_l - y_mean|^2 = sum_lm P_lm y_l . y_m,    P = I - 1 1^T / k,

over sigma_3D^2; and as sum_{l<m} |y_l - y_m|^2 = k sum_l |y_l - y_mean|^2, V_ICP / (2 sigma_3D^2) (eq. 2.6, 4.4) is the
same with each point weighted by k / 2. A pose is D_l T_l^0 with a motion D_l of the start, so that y_l = D_l y_l^0, and
everything follows from the moments of the vectors h_l = (e_l, y_l^0, 1), e_l = y_l^0 - y_mean^0: with
Delta = D - I (3 x 4) and Q = sum_j P_lm h_l h_m^T,

    cost = sum_lm tr Q_ee + 2 sum_l <c_l, Delta_l> + sum_lm tr(Delta_l Q_yy Delta_m^T),    c_l = sum_m Q_{e_m, y_l}.

Delta is small and the start's residuals enter directly, so that no digits cancel. With J_l = [-hat(y_l), I] the
gradient needs sum_j r_l y_l^T alone, and J^T P J needs sum_j P_lm y_l y_m^T alone (eq. A9: J_B^T B and J_B^T J_B).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.biobjective.groups import Grouping
from rgbd_calib.rig.biobjective.kernels import Memory

_IDENTITY = np.eye(3, 4)


@dataclass(frozen=True)
class _Moments:
    """Q by its parts."""

    ee: float
    """sum_lm tr Q_ee."""
    ey: FloatArray
    """(3, 4 N), the c_l side by side."""
    yy: FloatArray
    """(4 N, 4 N)."""


class MomentTerm:
    """3D points with isotropic noise and given correspondences; `pairs` weighs them as eq. 2.6 does."""

    def __init__(self, grouping: Grouping, xyz_m: FloatArray, T_start: FloatArray, pairs: bool) -> None:
        self.grouping = grouping
        self._blocks = [(block, block.gather(xyz_m)) for block in grouping.blocks]
        self._T_start, self._T_start_inv = T_start, se3.inverse(T_start)
        self._power = 1 if pairs else 0
        self.pairs = pairs
        self._Q: dict[int, _Moments] = {}
        self._precision = 1.0
        self._memory = Memory()

    def set_sigmas(self, sigmas: FloatArray) -> None:
        """Noise (N,) of the cameras, metres: one value, here."""
        self._precision = 1.0 / float(sigmas[0]) ** 2

    def evaluate(self, T: FloatArray) -> float:
        """Weighted sum of squares at the poses (N, 4, 4); the other methods are then for them."""
        self._D = T @ self._T_start_inv
        cost, self._F = self._expand(self._power)
        return cost

    def sum_of_squares(self, power: int) -> float:
        """At the last evaluated poses, each point weighted by (k / 2)^power."""
        return self._expand(power)[0]

    def normal(self) -> tuple[FloatArray, FloatArray]:
        """S (6 F, 6 F) and the right side g (6 F,) of S xi = g for the F = N - 1 free cameras."""
        F = self._F[1:] @ self._D[1:].transpose(0, 2, 1)  # sum_j r_l (y_l, 1)^T
        g = -np.stack(
            [F[:, 2, 1] - F[:, 1, 2], F[:, 0, 2] - F[:, 2, 0], F[:, 1, 0] - F[:, 0, 1], *F[:, :, 3].T], axis=1
        )
        return self.information(self._power), g.ravel()

    def information(self, power: int) -> FloatArray:
        """J^T P J (6 F, 6 F), weighted as :meth:`sum_of_squares`."""
        D = self._D[1:]
        n = len(D)
        Q = self._moments(power).yy.reshape(n + 1, 4, n + 1, 4)[1:, :, 1:]
        K = np.matmul(D, Q.reshape(n, 4, 4 * n)).reshape(n, 4, n, 4).transpose(0, 2, 1, 3)
        K = K @ D.transpose(0, 2, 1) * self._precision  # (l, m, 4, 4)
        S = np.empty((n, 6, n, 6))
        blocks = S.transpose(0, 2, 1, 3)
        blocks[..., :3, :3] = -K[..., :3, :3].swapaxes(2, 3)
        blocks[..., :3, 3:] = so3.hat(K[..., :3, 3])
        blocks[..., 3:, :3] = -so3.hat(K[..., 3, :3])
        blocks[..., 3:, 3:] = 0.0
        trace = K[..., 0, 0] + K[..., 1, 1] + K[..., 2, 2]
        for i in range(3):
            blocks[..., i, i] += trace
            blocks[..., 3 + i, 3 + i] = K[..., 3, 3]
        return S.reshape(6 * n, 6 * n)

    def _expand(self, power: int) -> tuple[float, FloatArray]:
        """The sum of squares, and sum_j r_l (y_l^0, 1)^T (N, 3, 4)."""
        Q, N = self._moments(power), len(self._D)
        delta = self._D[:, :3] - _IDENTITY
        delta = delta.transpose(1, 0, 2).reshape(3, 4 * N)
        moved = delta @ Q.yy
        cost = max(Q.ee + float(np.vdot(2 * Q.ey + moved, delta)), 0.0)  # exact data: 0 but for rounding
        return cost * self._precision, (Q.ey + moved).reshape(3, N, 4).transpose(1, 0, 2) * self._precision

    def _moments(self, power: int) -> _Moments:
        """Q for sigma = 1."""
        if power not in self._Q:
            Q, N = self._collect(power), len(self._T_start)
            self._Q[power] = _Moments(
                float(np.einsum("laia->", Q[:, :3, :, :3])),
                Q[:, :3, :, 3:].sum(axis=0).reshape(3, 4 * N),
                np.ascontiguousarray(Q[:, 3:, :, 3:]).reshape(4 * N, 4 * N),
            )
        return self._Q[power]

    def _collect(self, power: int) -> FloatArray:
        """Q (N, 7, N, 7)."""
        N = len(self._T_start)
        Q = np.zeros((N, 7, N, 7))
        entry = np.arange(7)
        for block, p in self._blocks:
            T = self._T_start[block.cameras]
            n_cameras, n = len(T), p.shape[2]
            h = self._memory.array("h", (n_cameras, 7, n))
            np.matmul(T[:, :3, :3], p, out=h[:, 3:6])
            h[:, 3:6] += T[:, :3, 3:]
            h[:, 6] = 1.0
            k: FloatArray | float = float(n_cameras)
            if block.seen is not None:
                h *= block.seen[:, None]
                k = h[:, 6].sum(axis=0)
            np.subtract(h[:, 3:6], h[:, 6:] * (h[:, 3:6].sum(axis=0) / k), out=h[:, :3])
            if power:
                h *= (k / 2) ** (power / 2)
            own = h @ h.transpose(0, 2, 1)
            h /= np.sqrt(k)
            flat = h.reshape(-1, n)
            part = -(flat @ flat.T).reshape(n_cameras, 7, n_cameras, 7)
            for i in range(n_cameras):
                part[i, :, i] += own[i]
            Q[np.ix_(block.cameras, entry, block.cameras, entry)] += part
        return Q

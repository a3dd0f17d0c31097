"""Terms of the cost whose points are unknowns: pixels (eq. 2.3), and 3D points with a covariance or a robust loss.

Both have residuals of the same kind, measured minus predicted in the camera's frame, so that both use the kernels:

    pixels   a_l^h = q_l^h - psi(K_l, T_l, x^h)                    (eq. 2.3, d = 2)
    points   p_l^j - R_l^T (x^j - t_l), whitened by its covariance  (eq. 2.5 against the latent point, d = 3)
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.biobjective import kernels
from rgbd_calib.rig.biobjective.groups import Grouping, PointGroup
from rgbd_calib.rig.biobjective.loss import Loss

_MIN_DEPTH_M = 1e-6
"""A point nearer than this, or behind the camera, has no pixel: the cost is infinite and the step is refused."""


class PointTerm(ABC):
    """Blocks of whitened residuals with latent points; subclasses say what a residual is."""

    dimension: int
    """Components d of one observation."""

    def __init__(self, grouping: Grouping, n_cameras: int, loss: Loss) -> None:
        self.grouping = grouping
        self.loss = loss
        self._n_free = n_cameras - 1
        self._weights: list[FloatArray | None] = [None] * len(grouping.blocks)
        self._residuals: list[FloatArray] = [np.empty(0)] * len(grouping.blocks)
        self._eliminated: list[kernels.Eliminated] = []
        self._memory = kernels.Memory()
        self._free = [block.cameras[block.first_free :] - 1 for block in grouping.blocks]
        self._at = [(6 * free[:, None] + np.arange(6)).ravel() for free in self._free]
        self._Y = [
            np.empty((len(b.cameras) - b.first_free, 6, 3, b.points.stop - b.points.start)) for b in grouping.blocks
        ]
        self.set_sigmas(np.ones(n_cameras))

    def set_sigmas(self, sigmas: FloatArray) -> None:
        """Noise (N,) of the cameras, px or m."""
        self._inverse_sigma = 1.0 / sigmas

    def evaluate(self, T: FloatArray, X: FloatArray) -> float:
        """Sum of the losses at the poses (N, 4, 4) and points (3, h); the next :meth:`normal` is for them."""
        total = 0.0
        self._T, self._X = T, X
        for i, block in enumerate(self.grouping.blocks):
            r = self._residual(i, block, T[block.cameras], X[:, block.points])
            if r is None:
                return float("inf")
            if block.seen is not None:
                r *= block.seen[:, None]
            if self.loss.is_squared:
                total += float(np.vdot(r, r))
            else:
                cost, self._weights[i] = self.loss(np.einsum("kdn,kdn->kn", r, r))
                total += cost
            self._residuals[i] = r
        return total

    def normal(self, damping: float) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """S (6 F, 6 F), g (6 F,), diagonal of U (6 F,), and |L^-1 g_x|^2, what the points alone can gain."""
        S, g = np.zeros((6 * self._n_free, 6 * self._n_free)), np.zeros(6 * self._n_free)
        U = np.zeros((self._n_free, 6))
        gain = 0.0
        self._eliminated = []
        for i, block in enumerate(self.grouping.blocks):
            A, r, _ = self._weighted(i, block)
            out = kernels.eliminate(A, r, self._X[:, block.points], block.first_free, damping, self._memory, self._Y[i])
            free, at = self._free[i], self._at[i]
            if len(at) == len(g):
                S += out.S
            else:
                S[at[:, None], at] += out.S
            g[at] += out.g
            U[free] += np.einsum("kaa->ka", out.U)
            gain += float(np.vdot(out.Lg, out.Lg))
            self._eliminated.append(out)
        return S, g, U.ravel(), gain

    def step(self, xi: FloatArray) -> FloatArray:
        """Step (3, h) of the points for a step (6 F,) of the poses, after :meth:`normal`."""
        step = np.empty_like(self._X)
        for block, at, out in zip(self.grouping.blocks, self._at, self._eliminated, strict=True):
            step[:, block.points] = out.point_step(xi[at])
        return step

    def squares_by_camera(self, C: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Sums of squares (N,) and redundancies (N,) of the cameras, after `normal(0)`; C (6 F, 6 F) is the poses'.

        A row's share of the unknowns is A V^-1 A^T + E C E^T, with its reduced row E = J - (L^-1 A^T)^T Y.
        """
        N = self._n_free + 1
        squares, redundancy = np.zeros(N), np.zeros(N)
        mean_weight, meat, _ = self.loss.constants(self.dimension)
        for i, (block, out) in enumerate(zip(self.grouping.blocks, self._eliminated, strict=True)):
            A, r, weights = self._weighted(i, block)
            X = self._X[:, block.points]
            B = np.empty_like(A)
            out.L.forward(A.swapaxes(0, 1), B.swapaxes(0, 1))
            at = self._at[i]
            Y = out.Y.reshape(len(at), 3, -1)
            for j, camera in enumerate(block.cameras):
                E = -np.einsum("crn,acn->arn", B[j], Y)
                own = j - block.first_free
                if own >= 0:
                    E[6 * own : 6 * own + 6] += kernels.pose_jacobian(A[j : j + 1], X, self._memory)[0]
                E = E.reshape(len(at), -1)
                absorbed = np.vdot(B[j], B[j]) + np.vdot(C[at[:, None], at], E @ E.T)
                count = weights[j].sum() / mean_weight
                squares[camera] += float(np.vdot(r[j] ** 2, np.broadcast_to(weights[j], r[j].shape))) / meat
                redundancy[camera] += self.dimension * count - absorbed
        return squares, redundancy

    def residuals(self) -> tuple[FloatArray, FloatArray]:
        """Residuals (rows, d) in sigmas and robust weights (rows,) in the order of the table; NaN where left out."""
        n_rows = self.grouping.n_observations + len(self.grouping.alone)
        d = self._residuals[0].shape[1]
        table, weights = np.full((n_rows, d), np.nan), np.full(n_rows, np.nan)
        for block, r, w in zip(self.grouping.blocks, self._residuals, self._weights, strict=True):
            seen = slice(None) if block.seen is None else block.seen
            rows = block.rows[seen].ravel()
            table[rows] = np.moveaxis(r, 1, -1)[seen].reshape(-1, d)
            weights[rows] = 1.0 if w is None else w[seen].ravel()
        return table, weights

    def _weighted(self, i: int, block: PointGroup) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A and r times the root of the weights, and the weights (k, n), zero where nothing is seen."""
        A, r, weights = self._jacobian(i, block), self._residuals[i], self._weights[i]
        if block.seen is not None:
            A *= block.seen[:, None, None]
        if weights is None:
            seen = np.ones(r.shape[::2]) if block.seen is None else block.seen.astype(float)
            return A, r, seen
        root = np.sqrt(weights)[:, None]
        A *= root[:, None]
        return A, r * root, weights if block.seen is None else weights * block.seen

    @abstractmethod
    def _residual(self, i: int, block: PointGroup, T: FloatArray, X: FloatArray) -> FloatArray | None:
        """Whitened residuals (k, d, n); None where a point has none."""

    @abstractmethod
    def _jacobian(self, i: int, block: PointGroup) -> FloatArray:
        """A (k, 3, d, n) at the state of the last residuals."""


class PixelTerm(PointTerm):
    """V_BA (eq. 2.4) over sigma_2D^2."""

    dimension = 2

    def __init__(
        self, grouping: Grouping, pixels_px: FloatArray, intrinsics: tuple[Intrinsics, ...], loss: Loss
    ) -> None:
        vectors = np.stack([camera.vector for camera in intrinsics])
        self._focal = vectors[:, :2]
        super().__init__(grouping, len(intrinsics), loss)
        self._lens = vectors[:, 4:] if np.any(vectors[:, 4:]) else None
        self._measured = []
        for block in grouping.blocks:
            centre, focal = vectors[block.cameras, 2:4, None], self._focal[block.cameras, :, None]
            self._measured.append((block.gather(pixels_px) - centre) / focal)
        self._state: list[tuple[FloatArray, FloatArray]] = [(np.empty(0), np.empty(0))] * len(grouping.blocks)

    def _block_lens(self, block: PointGroup) -> FloatArray | None:
        return None if self._lens is None else np.ascontiguousarray(self._lens[block.cameras].T[:, :, None])

    def set_sigmas(self, sigmas: FloatArray) -> None:
        """Noise (N,) of the cameras, px."""
        super().set_sigmas(sigmas)
        whitened = (self._focal * self._inverse_sigma[:, None])[:, :, None]
        self._block_focal = [whitened[block.cameras] for block in self.grouping.blocks]

    def _residual(self, i: int, block: PointGroup, T: FloatArray, X: FloatArray) -> FloatArray | None:
        P = kernels.camera_points(T[:, :3, :3], T[:, :3, 3], X)
        z = P[:, 2]
        if block.seen is not None:
            z[~block.seen] = 1.0
        if not z.min() > _MIN_DEPTH_M:
            return None
        z_inv = 1.0 / z
        xy = P[:, :2]
        xy *= z_inv[:, None]
        lens = self._block_lens(block)
        r = self._measured[i] - (xy if lens is None else kernels.distort(lens, xy))
        r *= self._block_focal[i]
        self._state[i] = (xy, z_inv)
        return r

    def _jacobian(self, i: int, block: PointGroup) -> FloatArray:
        xy, z_inv = self._state[i]
        R = self._T[block.cameras, :3, :3]
        return kernels.pixel_jacobian(R, xy, z_inv, self._block_focal[i], self._block_lens(block), self._memory)


class MeasuredPointTerm(PointTerm):
    """Sum of |p - R^T (x - t)|^2 over sigma_3D^2 in the metric of each measurement's own covariance."""

    dimension = 3

    def __init__(
        self, grouping: Grouping, xyz_m: FloatArray, covariance: FloatArray | None, n_cameras: int, loss: Loss
    ) -> None:
        super().__init__(grouping, n_cameras, loss)
        self._measured = [block.gather(xyz_m) for block in grouping.blocks]
        if covariance is None:
            covariance = np.broadcast_to(np.eye(3), (len(xyz_m), 3, 3))
        self.typical_scale = float(np.sqrt(np.median(np.trace(covariance, axis1=1, axis2=2)) / 3))
        """Median root mean square of the covariances: what a sigma of 1 is in metres."""
        whitening = np.linalg.inv(np.linalg.cholesky(covariance)).reshape(-1, 9)
        self._whitening = []
        for block in grouping.blocks:
            W = block.gather(whitening)
            self._whitening.append(W.reshape(len(W), 3, 3, -1))

    def _residual(self, i: int, block: PointGroup, T: FloatArray, X: FloatArray) -> FloatArray | None:
        miss = self._measured[i] - kernels.camera_points(T[:, :3, :3], T[:, :3, 3], X)
        scale = self._inverse_sigma[block.cameras, None, None]
        return np.einsum("krcn,kcn->krn", self._whitening[i], miss) * scale

    def _jacobian(self, i: int, block: PointGroup) -> FloatArray:
        R = self._T[block.cameras, :3, :3] * self._inverse_sigma[block.cameras, None, None]
        A: FloatArray = np.ascontiguousarray(np.einsum("krdn,kcd->kcrn", self._whitening[i], R))
        return A

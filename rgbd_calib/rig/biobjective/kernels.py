"""The arithmetic on one block of observations; component arrays are (cameras k, components, points n).

An observation's rows are whitened: residual r (d,), and A = -dr/dx (d, 3) by its point x in the world. A point that
moves by d x and a world that a camera's pose moves by xi = (phi, rho) change the residual in the same way,

    p_color = R^T (Exp(-phi) (x - rho) - t)   =>   -dr/dxi = A [hat(x), -I] =: J   (d, 6),    row a -> (a × x, -a),

so that one set of products A serves the point block V, the pose block U and what couples them (eq. A9, A11):

    V = sum_l A^T A    U_l = sum_h J^T J    W_lh = A^T J    g_x = sum_l A^T r    g_l = sum_h J^T r
    S = U - sum_h W^T V^-1 W = U - Y^T Y,   Y = L^-1 W,   V = L L^T,   reduced gradient g_l - Y^T L^-1 g_x.

Y is stored as a matrix (6 k, 3 n), so that the sum over all points of a block is one BLAS product, Y Y^T. Its inner
part is L^-1 A^T, by forward substitution over whole arrays. The damping of eq. A11 multiplies the diagonal of V.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray


class Memory:
    """Arrays that the blocks of a term use one after the other: fresh pages cost more than the arithmetic on them."""

    def __init__(self) -> None:
        self._arrays: dict[tuple[str, tuple[int, ...]], FloatArray] = {}

    def array(self, name: str, shape: tuple[int, ...]) -> FloatArray:
        """Uninitialised; the same one for the same name and shape."""
        if (name, shape) not in self._arrays:
            self._arrays[name, shape] = np.empty(shape)
        return self._arrays[name, shape]


@dataclass(frozen=True)
class Cholesky3:
    """L^-1 of L L^T for n symmetric 3x3 blocks, by entries: reciprocal diagonal and lower entries, each (n,)."""

    i0: FloatArray
    i1: FloatArray
    i2: FloatArray
    l10: FloatArray
    l20: FloatArray
    l21: FloatArray

    @classmethod
    def of(cls, V: FloatArray) -> Cholesky3:
        """V is (6, n): xx, xy, xz, yy, yz, zz. Blocks that are not positive definite give NaN."""
        xx, xy, xz, yy, yz, zz = V
        i0 = 1.0 / np.sqrt(xx)
        l10, l20 = xy * i0, xz * i0
        i1 = 1.0 / np.sqrt(yy - l10 * l10)
        l21 = (yz - l20 * l10) * i1
        return cls(i0, i1, 1.0 / np.sqrt(zz - l20 * l20 - l21 * l21), l10, l20, l21)

    def forward(self, b: FloatArray, out: FloatArray) -> None:
        """out = L^-1 b for b (3, ..., n)."""
        np.multiply(b[0], self.i0, out=out[0])
        np.multiply(b[1] - self.l10 * out[0], self.i1, out=out[1])
        np.multiply(b[2] - self.l20 * out[0] - self.l21 * out[1], self.i2, out=out[2])

    def backward(self, b: FloatArray) -> FloatArray:
        """L^-T b for b (3, n)."""
        o2 = b[2] * self.i2
        o1 = (b[1] - self.l21 * o2) * self.i1
        return np.stack([(b[0] - self.l10 * o1 - self.l20 * o2) * self.i0, o1, o2])


@dataclass(frozen=True)
class Eliminated:
    """A block's normal equations with its points eliminated."""

    U: FloatArray
    """(k free, 6, 6)."""
    S: FloatArray
    """(6 k free, 6 k free)."""
    g: FloatArray
    """(6 k free,), reduced."""
    Y: FloatArray
    """(6 k free, 3 n)."""
    Lg: FloatArray
    """L^-1 g_x, (3, n)."""
    L: Cholesky3

    def point_step(self, delta: FloatArray) -> FloatArray:
        """Step (3, n) of the points for a step (6 k free,) of the poses."""
        return self.L.backward(self.Lg - (delta @ self.Y).reshape(3, -1))


def camera_points(R: FloatArray, t: FloatArray, X: FloatArray) -> FloatArray:
    """Points (k, 3, n) in the cameras' frames: R (k, 3, 3) and t (k, 3) are T_world_color, X (3, n) in the world."""
    R_color_world = np.ascontiguousarray(R.transpose(0, 2, 1))
    shift = np.matmul(R_color_world, t[:, :, None])
    P = (R_color_world.reshape(-1, 3) @ X).reshape(len(R), 3, -1)
    P -= shift
    return P


def distort(k: FloatArray, xy: FloatArray) -> FloatArray:
    """Brown-Conrady on xy (k, 2, n), coefficients (5, k, 1): geometry.camera over whole blocks."""
    k1, k2, p1, p2, k3 = k
    x, y = xy[:, 0], xy[:, 1]
    r2, cross = x * x + y * y, 2.0 * x * y
    g = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack([x * g + p1 * cross + p2 * (r2 + 2 * x * x), y * g + p2 * cross + p1 * (r2 + 2 * y * y)], axis=1)


def distort_jacobian(k: FloatArray, xy: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Derivatives xx, xy = yx, yy of :func:`distort`, each (k, n)."""
    k1, k2, p1, p2, k3 = k
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    g = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    dg = 2.0 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    return (
        g + x * x * dg + 2 * p1 * y + 6 * p2 * x,
        x * y * dg + 2 * p1 * x + 2 * p2 * y,
        g + y * y * dg + 6 * p1 * y + 2 * p2 * x,
    )


def pixel_jacobian(
    R: FloatArray, xy: FloatArray, z_inv: FloatArray, focal: FloatArray, lens: FloatArray | None, memory: Memory
) -> FloatArray:
    """A (k, 3, 2, n) = d psi / dx (eq. 2.2), with `focal` (k, 2, 1) in px over sigma."""
    k, _, n = xy.shape
    # R is (world, camera): R[:, :, r] is the world's direction of camera axis r
    A = np.multiply(R[:, :, 2, None, None], xy[:, None], out=memory.array("A", (k, 3, 2, n)))
    np.subtract(R[:, :, :2, None], A, out=A)
    scale = np.multiply(focal, z_inv[:, None], out=memory.array("scale", (k, 2, n)))
    if lens is not None:
        dxx, dxy, dyy = distort_jacobian(lens, xy)
        A_x = A[:, :, 0] * dxx[:, None] + A[:, :, 1] * dxy[:, None]
        A[:, :, 1] = A[:, :, 0] * dxy[:, None] + A[:, :, 1] * dyy[:, None]
        A[:, :, 0] = A_x
    A *= scale[:, None]
    return A


def pose_jacobian(A: FloatArray, X: FloatArray, memory: Memory) -> FloatArray:
    """J (k, 6, d, n), rows (a × x, -a), from A (k, 3, d, n) and the points X (3, n)."""
    k, _, d, n = A.shape
    J = memory.array("J", (k, 6, d, n))
    buffer = memory.array("cross", (k, d, n))
    for c, a, b in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(A[:, a], X[b], out=J[:, c])
        np.multiply(A[:, b], X[a], out=buffer)
        J[:, c] -= buffer
    np.negative(A, out=J[:, 3:])
    return J


def point_blocks(A: FloatArray, r: FloatArray) -> tuple[FloatArray, FloatArray]:
    """V (6, n), entries xx, xy, xz, yy, yz, zz, and g_x (3, n)."""
    V = np.empty((6, A.shape[-1]))
    for entry, (a, b) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        np.einsum("krn,krn->n", A[:, a], A[:, b], out=V[entry])
    return V, np.einsum("kcrn,krn->cn", A, r)


def eliminate(
    A: FloatArray, r: FloatArray, X: FloatArray, first_free: int, damping: float, memory: Memory, Y: FloatArray
) -> Eliminated:
    """Normal equations of a block from A (k, 3, d, n), r (k, d, n) and the points X (3, n); Y (k free, 6, 3, n) is
    memory for the result."""
    d, n = r.shape[1:]
    V, g_x = point_blocks(A, r)
    if damping:
        V[[0, 3, 5]] *= 1.0 + damping
    L = Cholesky3.of(V)
    Lg = np.empty_like(g_x)
    L.forward(g_x, Lg)

    A, r = A[first_free:], r[first_free:]
    k = len(A)
    B = memory.array("B", A.shape)
    L.forward(A.swapaxes(0, 1), B.swapaxes(0, 1))
    J = pose_jacobian(A, X, memory)
    np.einsum("karn,kirn->kain", J, B, out=Y)
    Y = Y.reshape(6 * k, 3 * n)

    J = J.reshape(k, 6, d * n)
    U = J @ J.transpose(0, 2, 1)
    g = (J @ r.reshape(k, d * n, 1)).ravel() - Y @ Lg.ravel()
    S = Y @ Y.T
    np.negative(S, out=S)
    for i in range(k):
        S[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += U[i]
    return Eliminated(U, S, g, Y, Lg, L)

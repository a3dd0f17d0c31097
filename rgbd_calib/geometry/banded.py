"""Normal equations whose units are the windows of a spline: neighbours share knots, so that V is banded.

A window of N_KNOTS knots of 6 unknowns is a unit of 24; the rows of a view touch one window. Summed over the windows that hold
them, the knots' part of V is symmetric with a band of 24, and L L' = V by Cholesky costs time and memory linear in the knots.
What :mod:`.linear` needs of it is, window by window, the window's own block of V^-1 and its columns of W V^-1:

    W V^-1 W' = sum_w (W V^-1)_w W_w'         tr(V^-1 A) = sum_w tr((V^-1)_ww A_w)      where A = sum_w A_w

hold because W and A are sums over windows too, so that elimination, covariance and traces are those of :mod:`.linear`, given
V_inv and WV in this sense. The blocks of V^-1 inside the band come from L alone (K. Takahashi, J. Fagan, M.-S. Chin, 1973):
with B = L_{after, j} L_jj^-1 the knots after j within the band, Z_{after, j} = -Z_{after, after} B and
Z_jj = (L_jj L_jj')^-1 - B' Z_{after, j}. Z is carried as a square root, Z = S S', since rounding makes Z itself indefinite, and the
recursion overflow, over seconds without a view, where the prior of the motion alone holds the knots.

Units after the windows are as ever, each by itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded, solve_triangular

from rgbd_calib.geometry.linear import NormalEquations
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.geometry.spline import N_KNOTS

SIZE = 6
"""Unknowns of a knot."""
BAND = SIZE * N_KNOTS


@dataclass(frozen=True)
class BandedEquations(NormalEquations):
    """The first `n_windows` units are windows, in order of time; D = 24."""

    n_windows: int = 0

    @property
    def n_knots(self) -> int:
        return self.n_windows + N_KNOTS - 1

    def knots(self, of_windows: FloatArray) -> FloatArray:
        """Sums (6 K, ...) over the windows of values (windows, 24, ...)."""
        out = np.zeros((self.n_knots, SIZE, *of_windows.shape[2:]))
        parts = of_windows.reshape(self.n_windows, N_KNOTS, SIZE, *of_windows.shape[2:])
        for k in range(N_KNOTS):
            out[k : k + self.n_windows] += parts[:, k]
        return out.reshape(SIZE * self.n_knots, *of_windows.shape[2:])

    def windows(self, of_knots: FloatArray) -> FloatArray:
        """Values (windows, 24, ...) of each window, of those of the knots (6 K, ...)."""
        parts = of_knots.reshape(self.n_knots, SIZE, *of_knots.shape[1:])
        every = [parts[k : k + self.n_windows] for k in range(N_KNOTS)]
        return np.concatenate(every, axis=1)

    @cached_property
    def factor(self) -> FloatArray:
        """(24, 6 K): L in scipy's lower banded form."""
        band, V = np.zeros((BAND, SIZE * self.n_knots)), self.V[: self.n_windows]
        first = SIZE * np.arange(self.n_windows)
        for j in range(BAND):
            np.add.at(band, (np.arange(BAND - j)[None], (first + j)[:, None]), V[:, j:, j])
        return np.asarray(cholesky_banded(band, lower=True))

    def solve(self, of_knots: FloatArray) -> FloatArray:
        """V^-1 of (6 K, ...)."""
        flat = of_knots.reshape(len(of_knots), -1)
        return np.asarray(cho_solve_banded((self.factor, True), flat)).reshape(of_knots.shape)

    @cached_property
    def V_inv(self) -> FloatArray:
        """(F, 24, 24): of a window, its block of V^-1."""
        out = np.empty_like(self.V)
        out[self.n_windows :] = np.linalg.inv(self.V[self.n_windows :])
        out[: self.n_windows] = self._inverse_blocks()
        return out

    def _inverse_blocks(self) -> FloatArray:
        L, K, n = self.factor, self.n_knots, BAND - SIZE
        out = np.zeros((self.n_windows, BAND, BAND))
        S = np.zeros((n, n))  # Z = S S' of the knots after, zero beyond the last
        diagonal, below = np.zeros((K, SIZE, SIZE)), np.zeros((K, n, SIZE))
        for column in range(SIZE):
            of_column = L[:, column::SIZE]
            diagonal[:, column:, column] = of_column[: SIZE - column].T
            below[:, :, column] = of_column[SIZE - column : BAND - column].T
        for k in range(K - 1, -1, -1):
            inverse = solve_triangular(diagonal[k], np.eye(SIZE), lower=True)
            root = np.zeros((BAND, BAND))
            root[:SIZE, :SIZE], root[:SIZE, SIZE:], root[SIZE:, SIZE:] = inverse.T, -(below[k] @ inverse).T @ S, S
            if k < self.n_windows:
                out[k] = root @ root.T
            S = np.asarray(np.linalg.qr(root[:n].T, mode="r")).T
        return out

    @cached_property
    def _eliminated(self) -> FloatArray:
        """V^-1 W' (6 K, P) of the knots."""
        right = np.zeros((SIZE * self.n_knots, self.pattern.n_globals))
        for W, units, at in zip(self.W, self.pattern.units, self.pattern.columns, strict=True):
            mine = units < self.n_windows
            if not mine.any():
                continue
            of_windows = np.zeros((self.n_windows, BAND, len(at)))
            of_windows[units[mine]] = W[mine].transpose(0, 2, 1)
            right[:, at] += self.knots(of_windows)
        return self.solve(right)

    @cached_property
    def WV(self) -> tuple[FloatArray, ...]:
        """W V^-1 by group, each window with its own columns of it."""
        of_windows, out = self.windows(self._eliminated), []  # (windows, 24, P)
        for W, units, at in zip(self.W, self.pattern.units, self.pattern.columns, strict=True):
            own, mine = np.empty_like(W), units < self.n_windows
            own[mine] = of_windows[units[mine]][:, :, at].transpose(0, 2, 1)
            own[~mine] = W[~mine] @ self.V_inv[units[~mine]] if (~mine).any() else 0.0
            out.append(own)
        return tuple(out)

    def unit_solved(self, right: FloatArray) -> FloatArray:
        """V^-1 of (F, 24, ...), of which those of windows are summed over what they share."""
        out = np.empty_like(right)
        n = self.n_windows
        out[:n] = self.windows(self.solve(self.knots(right[:n])))
        if len(right) > n:
            out[n:] = (self.V_inv[n:] @ right[n:].reshape(*right[n:].shape[:2], -1)).reshape(right[n:].shape)
        return out

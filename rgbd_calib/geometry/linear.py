"""Least squares whose unknowns are some hundred globals and many small units that touch only each other through them.

The normal equations of globals x and units b (one D x D block each; a board's pose, a wall's plane, the corners of a frame):

    [ U  W ] [x]     [ g ]          S = U - W V^-1 W'      S x = -(g - W V^-1 h)
    [ W' V ] [b] = - [ h ]          b = -V^-1 (h + W' x)

with Cov_xx = S^-1, Cov_xb = -S^-1 W V^-1 and Cov_bb = V^-1 + V^-1 W' S^-1 W V^-1 (the paper, eq. A9-A11). A unit touches a few
of the globals: units with the same ones are a group, whose part of W is dense. Rows come in batches (:class:`Rows`), each
view's with dense columns and with a few columns of single points.

Rows whose errors are not independent have a weight matrix of their own, I - Q C Q' for each view: their products are those of
the rows less those of a few rows C^(1/2) Q' (:meth:`Rows.parts`), which are taken off.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from rgbd_calib.geometry.so3 import FloatArray

IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def symmetric_inverse(A: FloatArray) -> FloatArray:
    """Pseudo-inverse (n, n) of a positive semidefinite matrix (n, n) of parameters of any units.

    Scaled to a unit diagonal first: what a pseudo-inverse takes for zero is measured against the largest eigenvalue, and
    the information of a focal length in pixels is 1e-16 of that of a curvature in 1/m. Rows of zeros stay zero.
    """
    diagonal = np.diag(A)
    scale = np.where(diagonal > 0, 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), 0.0)
    unit = np.linalg.pinv(A * np.outer(scale, scale), rcond=1e-12, hermitian=True)
    return np.asarray(unit * np.outer(scale, scale), float)


def product(A: FloatArray, B: FloatArray) -> FloatArray:
    """Sum over f of A[f] B[f]', of (F, p, m) and (F, q, m), as one matrix product."""
    (F, p, m), q = A.shape, B.shape[1]
    return np.asarray(A.transpose(1, 0, 2).reshape(p, F * m) @ B.transpose(1, 0, 2).reshape(q, F * m).T, float)


@dataclass(frozen=True)
class Rows:
    """Weighted rows of n views of one key: N points with r rows each, G dense columns, s columns of each point."""

    units: IntArray
    """(n,), the unit that each view touches."""
    columns: IntArray
    """(G,), globals of the dense columns, the same for all views."""
    J: FloatArray
    """(n, N, r, G)."""
    J_unit: FloatArray
    """(n, N, r, D)."""
    r: FloatArray
    """(n, N, r)."""
    point_columns: IntArray
    """(n, N, s), globals of the points' own columns, none twice in a view."""
    J_point: FloatArray
    """(n, N, r, s)."""

    def flat(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """J (n, N r, G), J_unit (n, N r, D) and r (n, N r)."""
        n = len(self.units)
        return (
            self.J.reshape(n, -1, self.J.shape[-1]),
            self.J_unit.reshape(n, -1, self.J_unit.shape[-1]),
            self.r.reshape(n, -1),
        )

    def parts(self, Q: FloatArray) -> Rows:
        """Q' times the rows, Q (n, N r, d): d rows of one point, whose columns are those of all points."""
        J, J_unit, r = self.flat()
        n, N, per, s = self.J_point.shape
        Q_t = Q.transpose(0, 2, 1)
        d = Q_t.shape[1]
        J_point = np.einsum("ndkr,nkrs->ndks", Q_t.reshape(n, d, N, per), self.J_point).reshape(n, 1, d, N * s)
        every = self.point_columns.reshape(n, 1, N * s)
        own = (Q_t @ r[..., None])[:, None, :, 0]
        return Rows(self.units, self.columns, (Q_t @ J)[:, None], (Q_t @ J_unit)[:, None], own, every, J_point)

    def times(self, factor: FloatArray) -> Rows:
        """Each row times a factor (..., r)."""
        w = factor[..., None]
        return replace(self, J=self.J * w, J_unit=self.J_unit * w, r=self.r * factor, J_point=self.J_point * w)

    def moved(self, step: FloatArray, unit_step: FloatArray) -> FloatArray:
        """What steps of the globals (P,) and of the units (F, D) add to the rows, (n, N, r)."""
        out = self.J @ step[self.columns]
        out = out + np.einsum("nird,nd->nir", self.J_unit, unit_step[self.units])
        return np.asarray(out + np.einsum("nirs,nis->nir", self.J_point, step[self.point_columns]))


@dataclass(frozen=True)
class Pattern:
    """Which of the globals each unit touches."""

    n_globals: int
    size: int
    """D."""
    group: IntArray
    """(F,), the group of each unit."""
    place: IntArray
    """(F,), its place there."""
    units: tuple[IntArray, ...]
    """By group, its units."""
    columns: tuple[IntArray, ...]
    """By group, the globals that they touch, ascending."""

    @classmethod
    def of(
        cls, touched: Sequence[tuple[int, ...]], columns: dict[tuple[int, ...], IntArray], P: int, D: int
    ) -> Pattern:
        """Of the key of each unit, and the globals behind each key."""
        keys = sorted(set(touched))
        number = {key: k for k, key in enumerate(keys)}
        group = np.array([number[key] for key in touched], int)
        units = tuple(np.flatnonzero(group == k) for k in range(len(keys)))
        place = np.zeros(len(group), int)
        for own in units:
            place[own] = np.arange(len(own))
        return cls(P, D, group, place, units, tuple(columns[key] for key in keys))

    @property
    def n_units(self) -> int:
        return len(self.group)

    @cached_property
    def position(self) -> IntArray:
        """(groups, P), where a global stands among the columns of a group; 0 where it does not."""
        out = np.zeros((len(self.columns), self.n_globals), int)
        for k, own in enumerate(self.columns):
            out[k, own] = np.arange(len(own))
        return out


def _alike(rows: IntArray) -> list[IntArray]:
    """Numbers of the equal ones among rows (n, k), group by group."""
    members = dict[bytes, list[int]]()
    for k, row in enumerate(rows):
        members.setdefault(row.tobytes(), []).append(k)
    return [np.array(own) for own in members.values()]


def _add_to(total: FloatArray, units: IntArray, values: FloatArray, columns: IntArray | None = None) -> None:
    """Adds values of units (n,), or of units and columns (n, k): ten times faster where no unit occurs twice."""
    at = units if columns is None else (units[:, None], columns)
    if len(set(units.tolist())) == len(units):
        total[at] += values
    else:
        np.add.at(total, at, values)


class Assembly:
    """Normal equations under construction."""

    def __init__(self, pattern: Pattern) -> None:
        P, F, D = pattern.n_globals, pattern.n_units, pattern.size
        self._pattern = pattern
        self._U, self._g = np.zeros((P, P)), np.zeros(P)
        self._V, self._h = np.zeros((F, D, D)), np.zeros((F, D))
        self._W = [np.zeros((len(u), len(c), D)) for u, c in zip(pattern.units, pattern.columns, strict=True)]

    def add(self, rows: Rows, sign: float = 1.0) -> None:
        """The products of rows; with the sign -1 they are taken off."""
        J, J_unit, r = rows.flat()
        at = rows.columns
        every = J.reshape(-1, J.shape[-1])
        self._U[np.ix_(at, at)] += sign * (every.T @ every)
        self._g[at] += sign * (r.ravel() @ every)
        _add_to(self._V, rows.units, sign * (J_unit.transpose(0, 2, 1) @ J_unit))
        _add_to(self._h, rows.units, sign * (r[:, None] @ J_unit)[:, 0])
        self._couple(rows.units, np.broadcast_to(at, (len(r), len(at))), sign * (J.transpose(0, 2, 1) @ J_unit))
        if rows.J_point.shape[-1]:
            self._add_points(rows, sign)

    def _add_points(self, rows: Rows, sign: float) -> None:
        n, N, _, s = rows.J_point.shape
        by_unit = sign * np.einsum("nirs,nird->nisd", rows.J_point, rows.J_unit).reshape(n, N * s, -1)
        self._couple(rows.units, rows.point_columns.reshape(n, -1), by_unit)
        # views that see the same points are added up before they are scattered
        for mine in _alike(rows.point_columns.reshape(n, -1)):
            own = rows.point_columns[mine[0]]
            J_point = rows.J_point[mine].transpose(1, 3, 0, 2).reshape(N, s, -1)
            J = rows.J[mine].transpose(1, 0, 2, 3).reshape(N, J_point.shape[-1], -1)
            signed = sign * J_point
            cross = signed @ J
            self._U[own[:, :, None], rows.columns] += cross
            self._U[rows.columns[:, None, None], own] += cross.transpose(2, 0, 1)
            self._U[own[:, :, None], own[:, None]] += signed @ J_point.transpose(0, 2, 1)
            r = rows.r[mine].transpose(1, 0, 2).reshape(N, -1, 1)
            self._g[own] += (signed @ r)[..., 0]

    def _couple(self, units: IntArray, columns: IntArray, values: FloatArray) -> None:
        """Adds (n, k, D) to W at units (n,) and globals (n, k)."""
        own = self._pattern
        group = own.group[units]
        for g in np.flatnonzero(np.bincount(group)):
            mine = group == g
            at = own.position[g, columns[mine]]
            _add_to(self._W[g], own.place[units[mine]], values[mine], at)

    def equations(self) -> NormalEquations:
        curvature = np.diag(self._U).copy()
        return NormalEquations(self._pattern, self._U, tuple(self._W), self._V, self._g, self._h, curvature)


def assemble(pattern: Pattern, rows: Iterable[Rows]) -> NormalEquations:
    """The normal equations of all rows."""
    out = Assembly(pattern)
    for batch in rows:
        out.add(batch)
    return out.equations()


@dataclass(frozen=True)
class NormalEquations:
    """Products of all rows."""

    pattern: Pattern
    U: FloatArray
    """(P, P)."""
    W: tuple[FloatArray, ...]
    """By group, (units, columns, D)."""
    V: FloatArray
    """(F, D, D)."""
    gradient: FloatArray
    """(P,)."""
    unit_gradient: FloatArray
    """(F, D)."""
    curvature: FloatArray
    """(P,), the diagonal of U of the rows alone, to which a step is damped: what is known before is linear."""

    def plus(self, information: FloatArray, gradient: FloatArray) -> NormalEquations:
        """With Gaussian knowledge of the globals: its information (P, P) and gradient (P,)."""
        return replace(self, U=self.U + information, gradient=self.gradient + gradient)

    def plus_units(self, information: FloatArray, gradient: FloatArray) -> NormalEquations:
        """With Gaussian knowledge of the units: the diagonal of its information (F, D), and its gradient (F, D)."""
        V = self.V + information[:, :, None] * np.eye(self.pattern.size)
        return replace(self, V=V, unit_gradient=self.unit_gradient + gradient)

    def regular(self) -> NormalEquations:
        """Unknowns of units that no row touches stay where they are."""
        V = self.V.copy()
        unit, k = np.nonzero(np.einsum("fii->fi", V) == 0)
        V[unit, k, k] = 1.0
        return replace(self, V=V)

    @cached_property
    def V_inv(self) -> FloatArray:
        """(F, D, D)."""
        return np.asarray(np.linalg.inv(self.V), float)

    @cached_property
    def WV(self) -> tuple[FloatArray, ...]:
        """W V^-1 by group."""
        return tuple(W @ self.V_inv[units] for W, units in zip(self.W, self.pattern.units, strict=True))

    @cached_property
    def reduced(self) -> FloatArray:
        """S (P, P)."""
        S = self.U.copy()
        for W, WV, at in zip(self.W, self.WV, self.pattern.columns, strict=True):
            S[np.ix_(at, at)] -= product(WV, W)
        return S

    @cached_property
    def reduced_gradient(self) -> FloatArray:
        """g - W V^-1 h, (P,)."""
        g = self.gradient.copy()
        for WV, units, at in zip(self.WV, self.pattern.units, self.pattern.columns, strict=True):
            g[at] -= np.einsum("npd,nd->p", WV, self.unit_gradient[units])
        return g

    def units_after(self, step: FloatArray) -> FloatArray:
        """The units' steps (F, D) that belong to a step of the globals (P,)."""
        right = self.unit_gradient.copy()
        for W, units, at in zip(self.W, self.pattern.units, self.pattern.columns, strict=True):
            right[units] += np.einsum("npd,p->nd", W, step[at])
        return -self.unit_solved(right)

    def unit_solved(self, right: FloatArray) -> FloatArray:
        """V^-1 of (F, D, ...)."""
        return (self.V_inv @ right.reshape(*right.shape[:2], -1)).reshape(right.shape)

    def step(self, free: BoolArray, damping: float) -> tuple[FloatArray, FloatArray] | None:
        """The damped step (P,), (F, D) of the free globals (P,) and the units; None where the equations are singular."""
        D = self.pattern.size
        V = self.V + damping * np.einsum("fii->fi", self.V)[:, :, None] * np.eye(D)
        damped = replace(self, V=V)
        try:
            S = damped.reduced[np.ix_(free, free)]
            S[np.diag_indices(len(S))] += damping * self.curvature[free]
            scale = 1 / np.sqrt(np.maximum(np.diag(S), 1e-300))
            factor = cho_factor(S * np.outer(scale, scale))
        except np.linalg.LinAlgError:
            return None
        step = np.zeros(len(free))
        step[free] = -scale * cho_solve(factor, scale * damped.reduced_gradient[free])
        return step, damped.units_after(step)

    def covariance(self, free: BoolArray) -> Covariance:
        """Of all unknowns, those that are not free (P,) known exactly.

        Raises
        ------
        numpy.linalg.LinAlgError
            The equations are singular.
        """
        S = self.reduced[np.ix_(free, free)]
        if not np.all(np.diag(S) > 0):  # rounding alone is left of some
            raise np.linalg.LinAlgError("not positive definite")
        scale = 1 / np.sqrt(np.diag(S))
        L = np.linalg.cholesky(S * np.outer(scale, scale))
        L_inv = solve_triangular(L, np.diag(scale), lower=True)
        C = np.zeros_like(self.U)
        C[np.ix_(free, free)] = L_inv.T @ L_inv
        return Covariance(self, C)


@dataclass(frozen=True)
class Covariance:
    """Inverse of the normal equations; rows and columns of held globals are zero."""

    equations: NormalEquations
    of_globals: FloatArray
    """(P, P)."""

    def cross(self, units: IntArray, columns: IntArray | None = None) -> FloatArray:
        """Cov of the globals, or some of them (k,), and of units (n,): (n, k, D)."""
        own = self.equations.pattern
        of_globals = self.of_globals if columns is None else self.of_globals[columns]
        out = np.empty((len(units), len(of_globals), own.size))
        for g in np.unique(own.group[units]):
            mine = np.flatnonzero(own.group[units] == g)
            WV = self.equations.WV[g][own.place[units[mine]]]  # (n, p, D)
            flat = of_globals[:, own.columns[g]] @ WV.transpose(1, 0, 2).reshape(WV.shape[1], -1)
            out[mine] = -flat.reshape(len(of_globals), len(mine), own.size).transpose(1, 0, 2)
        return out

    @cached_property
    def _carried(self) -> tuple[FloatArray, ...]:
        """Covariance of the globals times W V^-1, by group."""
        columns = self.equations.pattern.columns
        return tuple(self.of_globals[np.ix_(at, at)] @ WV for WV, at in zip(self.equations.WV, columns, strict=True))

    @cached_property
    def of_units(self) -> FloatArray:
        """(F, D, D)."""
        eq = self.equations
        out = eq.V_inv.copy()
        for WV, carried, units in zip(eq.WV, self._carried, eq.pattern.units, strict=True):
            out[units] += WV.transpose(0, 2, 1) @ carried
        return out

    def trace(self, part: NormalEquations) -> float:
        """tr(J Cov J') of the rows behind other normal equations of the same pattern."""
        total = float(np.sum(self.of_globals * part.U) + np.sum(self.of_units * part.V))
        return total - 2 * sum(float(np.vdot(own, W)) for own, W in zip(self._carried, part.W, strict=True))


def reduced_information(rows: Iterable[Rows], columns: IntArray) -> FloatArray:
    """What the rows of one unit say of the globals `columns` (p,), whatever the unit is: (p, p), its unknowns eliminated."""
    place = np.full(int(columns.max(initial=0)) + 1, -1)
    place[columns] = np.arange(len(columns))
    dense, units = [], []
    for batch in rows:
        n, N, r, s = batch.J_point.shape
        A = np.zeros((n, N, r, len(columns)))
        A[..., place[batch.columns]] = batch.J
        if s:
            view, corner = np.arange(n)[:, None, None], np.arange(N)[:, None]
            A.transpose(0, 1, 3, 2)[view, corner, place[batch.point_columns]] = batch.J_point.transpose(0, 1, 3, 2)
        dense.append(A.reshape(-1, len(columns)))
        units.append(batch.J_unit.reshape(len(dense[-1]), -1))
    A, B = np.concatenate(dense), np.concatenate(units)
    values, vectors = np.linalg.eigh(B.T @ B)
    seen = values > 1e-12 * values[-1]
    root = vectors[:, seen] / np.sqrt(values[seen])  # (B'B)^+ = root root'
    W = A.T @ (B @ root)
    return np.asarray(A.T @ A - W @ W.T)

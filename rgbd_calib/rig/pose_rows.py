"""The pose parts of every view's rows: what they say of the globals and units, and what the fit absorbed of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.linear import Covariance, IntArray, Rows
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Kind
from rgbd_calib.rig.problem import Problem, State
from rgbd_calib.rig.sight import Look
from rgbd_calib.rig.weights import N_DEPTH, N_PIXEL

N_PARTS = N_PIXEL + N_DEPTH


@dataclass(frozen=True)
class PoseRows:
    """V views, D unknowns of a unit, N_PARTS parts: pixels first."""

    of_globals: FloatArray
    """(V, parts, P), Q' J."""
    of_units: FloatArray
    """(V, parts, D)."""
    residual: FloatArray
    """(V, parts), Q' r."""
    units: IntArray
    """(V, parts), the unit that each touches."""

    def carried(self, covariance: Covariance, problem: Problem) -> tuple[FloatArray, FloatArray]:
        """Their products with the covariance: (V, parts, P) of the globals, and (V, parts, D) of each view's unit."""
        of_globals, of_units = [], []
        for part in (slice(0, N_PIXEL), slice(N_PIXEL, N_PARTS)):
            units, by_globals, by_units = self.units[:, part.start], self.of_globals[:, part], self.of_units[:, part]
            cross, own = covariance.cross(units), covariance.of_units[units]
            of_globals.append(by_globals @ covariance.of_globals + by_units @ cross.transpose(0, 2, 1))
            of_units.append(by_globals @ cross + by_units @ own)
        return np.concatenate(of_globals, axis=1), np.concatenate(of_units, axis=1)

    def absorbed(self, covariance: Covariance, camera: IntArray) -> FloatArray:
        """Variance of the parts by that of the unknowns, (V, parts); views of one `camera` (V,) touch the same globals."""
        out = np.zeros(self.residual.shape)
        for c in np.unique(camera):
            mine = np.flatnonzero(camera == c)
            columns = np.flatnonzero(self.of_globals[mine].any(axis=(0, 1)))
            C = covariance.of_globals[np.ix_(columns, columns)]
            for part in (slice(0, N_PIXEL), slice(N_PIXEL, N_PARTS)):
                units, by_units = self.units[mine, part.start], self.of_units[mine, part]
                by_globals = self.of_globals[mine, part][:, :, columns]
                shared = 2 * by_globals @ covariance.cross(units, columns) + by_units @ covariance.of_units[units]
                out[mine, part] = np.sum((by_globals @ C) * by_globals, axis=2) + np.sum(shared * by_units, axis=2)
        return out


def pose_rows(problem: Problem, state: State, seen: Callable[[Look, Rows], None] | None = None) -> PoseRows:
    """At a state; `seen` is called with all rows on the way."""
    V = len(problem.obs.camera)
    out = np.zeros((V, N_PARTS, problem.n_globals)), np.zeros((V, N_PARTS, problem.unit_size)), np.zeros((V, N_PARTS))
    units = np.zeros((V, N_PARTS), int)
    for views, look, rows in problem.rows(state):
        if seen is not None:
            seen(look, rows)
        Q, at = problem.weights.parts(look.kind)[0], part_of(look.kind)
        units[views, at] = rows.units[:, None]
        for target, own in zip(out, dense(rows.parts(Q[views]), problem.n_globals), strict=True):
            target[views, at] = own
    return PoseRows(*out, units)


def part_of(kind: Kind) -> slice:
    """Where the parts of a kind of rows stand among all."""
    return slice(0, N_PIXEL) if kind is Kind.PIXEL else slice(N_PIXEL, N_PARTS)


def dense(parts: Rows, P: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Q' J (n, d, P), Q' J_unit (n, d, D) and Q' r (n, d) of :meth:`Rows.parts`."""
    J, J_unit, r = parts.flat()
    n, d, _ = J.shape
    of_globals = np.zeros((n, d, P))
    of_globals[:, :, parts.columns] = J
    at = np.arange(n)[:, None, None], np.arange(d)[:, None], parts.point_columns
    np.add.at(of_globals, at, parts.J_point[:, 0])
    return of_globals, J_unit, r

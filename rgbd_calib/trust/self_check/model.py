"""A solution as its checks need it: products of each view's rows, and what follows from them before any error is tested."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rgbd_calib.geometry.linear import BoolArray, Covariance, IntArray
from rgbd_calib.geometry.so3 import FloatArray


@dataclass(frozen=True)
class ViewRows:
    """Products of each view's rows; V views, H columns of possible errors, L of the globals, D of a unit, parts of the pose.

    Rows of K kinds touch a unit each: pixels and depth of one view are of two windows of a carried board's spline.
    """

    units: IntArray
    """(V, K)."""
    index: IntArray
    """(V, L), the global of each local column."""
    gram: FloatArray
    """(V, H, H)."""
    by_globals: FloatArray
    """(V, H, L)."""
    by_unit: FloatArray
    """(V, K, H, D)."""
    score: FloatArray
    """(V, H), with the residuals, predicted less measured."""
    low: FloatArray
    """(V, parts, H), in the pose parts."""
    low_globals: FloatArray
    """(V, parts, P), the model's own."""
    low_unit: FloatArray
    """(V, parts, D)."""
    low_residual: FloatArray
    """(V, parts)."""
    size: FloatArray
    """(V, H, H), products in metres at the board, for the size of an effect."""
    kind: IntArray
    """(parts,), which of the kinds each pose part is of."""

    @property
    def unit_of_part(self) -> IntArray:
        """(V, parts)."""
        return self.units[:, self.kind]


@dataclass(frozen=True)
class SolvedModel:
    """The solution, before errors are taken into it."""

    rows: ViewRows
    plain: Covariance
    free: BoolArray
    """(P,)."""

    @cached_property
    def reduced_low(self) -> FloatArray:
        """(V, parts, P), the model's columns in the pose parts, the units eliminated."""
        own, base = self.rows, self.plain.equations
        out = own.low_globals * self.free
        for of_kind, units in enumerate(own.units.T):
            parts = np.flatnonzero(own.kind == of_kind)
            group = base.pattern.group[units]
            for g in np.unique(group):
                mine = np.flatnonzero(group == g)
                WV = base.WV[g][base.pattern.place[units[mine]]]
                through = own.low_unit[np.ix_(mine, parts)] @ WV.transpose(0, 2, 1)
                out[np.ix_(mine, parts, base.pattern.columns[g])] -= through
        return np.asarray(out * self.free)

    @cached_property
    def step(self) -> tuple[FloatArray, FloatArray]:
        """What the solution still lacks of the minimum, (P,) and (F, D): zero but for rounding and what was held."""
        x = -self.plain.of_globals @ self.plain.equations.reduced_gradient
        return x, self.plain.equations.units_after(x)

    @cached_property
    def pose_parts(self) -> tuple[FloatArray, FloatArray]:
        """Of the views (V, parts): the pose parts at the minimum, and how much of their variance the model absorbs."""
        own, reduced = self.rows, self.reduced_low
        absorbed = np.sum((reduced @ self.plain.of_globals) * reduced, axis=2)
        for k, units in enumerate(own.units.T):
            parts = own.kind == k
            low_unit = own.low_unit[:, parts]
            absorbed[:, parts] += np.sum(low_unit @ self.plain.equations.V_inv[units] * low_unit, axis=2)
        x, b = self.step
        left = own.low_residual + own.low_globals @ x + np.einsum("vdi,vdi->vd", own.low_unit, b[own.unit_of_part])
        return left, absorbed

"""Frames taken away from a solution, without solving again, and what they say of the solution without them.

Taking frames away works on the same equations. With the boards eliminated, the frames F add S_F to the reduced normal
equations S and g_F to their gradient, so that without them

    x_(-F) = x - (S - S_F)^-1 (g - g_F)

where S - S_F and g - g_F are those of the other frames (a carried board's motion ties frames to each other: what F adds is
what the others lack). This is the deletion formula of linear regression for groups (Cook, Weisberg) and one Gauss-Newton step of a real refit.
At x_(-F) the frames F have the gradient h = g_F + S_F (x_(-F) - x). If all frames are of one rig, its variance is
B_F + S_F Cov_(-F) S_F + D' D, and h' Var(h)^+ h ~ chi2(rank). B_F is the frames' own information with the excess, and the
rows of D are what the errors add that views share: with C_F and C_(-F) their parts of the gradients (K, P), x_(-F) moves by
-C_(-F) (S - S_F)^-1 and D = C_F - C_(-F) (S - S_F)^-1 S_F.

References
----------
R. D. Cook, S. Weisberg, Residuals and Influence in Regression, Chapman and Hall, 1982, chapters 2 and 3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rgbd_calib.geometry.linear import BoolArray, IntArray, NormalEquations, symmetric_inverse
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.geometry.tails import chi2_sf, f_sf
from rgbd_calib.trust.self_check.equations import ALONE, Equations
from rgbd_calib.trust.self_check.findings import Finding, SelfCheckParams

HELD_BY = 1e-4
"""Information of a unit without rows, 1/rad^2 and 1/m^2: above the rounding of rows that were subtracted, some 1e-7, and 100 m."""
UNTOUCHED = 1e-9
"""Of a parameter's information: where the frames taken away have less, what they say of it is rounding."""


@dataclass(frozen=True)
class Deletion:
    """The solution without some frames, and how well those frames agree with it; E errors that were taken into the model."""

    step: FloatArray
    """(P + E,), x_(-F) - x."""
    covariance: FloatArray
    """(P + E, P + E), of x_(-F), by the errors that views do not share."""
    common: FloatArray
    """(K, P + E), what each of the K errors that views share moves x_(-F) by, in its standard deviations."""
    statistic: float
    dof: int
    p: float


@dataclass(frozen=True)
class HeldOut:
    """Part of the frames against the solution without them."""

    first: str
    last: str
    chi2: float
    dof: int
    others: float
    """Mean of chi2 / dof of the other parts, at least 1: what every part of the recording leaves beyond the model is no
    difference between the parts."""
    p: float
    """Chance of such a ratio to the other parts (F distribution)."""
    moves_mm: float
    """RMS by which cameras put the board apart in them, beyond the noise."""


def delete(eq: Equations, gone: BoolArray) -> Deletion:
    """Take the views `gone` (V,) away, all of their frames."""
    free = np.concatenate([eq.free, np.ones(sum(len(t.columns) for t in eq.taken), bool)])
    S, g = _reduced(eq, eq.base, np.ones(len(gone), bool))
    S_left, g_left = _reduced(eq, _without(eq, gone), ~gone)
    S_gone, g_gone = S - S_left, g - g_left
    held = np.diag(1.0 - free)
    left = symmetric_inverse(S_left * np.outer(free, free) + held) * np.outer(free, free)
    step = -left @ (g_left * free)
    low = np.concatenate([eq.model.reduced_low, *(_low(eq, k) for k in range(len(eq.taken)))], axis=2) * free

    def excess(views: BoolArray) -> FloatArray:
        return np.asarray(np.einsum("d,vdp,vdq->pq", eq.excess, low[views], low[views], optimize=True))

    covariance = left + left @ excess(~gone) @ left
    of_gone = eq.common(np.flatnonzero(gone))
    # errors that were taken into the model are not followed
    beside = [(0, 0), (0, len(free) - of_gone.shape[1])]
    of_gone, of_left = np.pad(of_gone, beside), np.pad(eq.common_of_all - of_gone, beside)
    common = -of_left @ left
    S_gone, g_gone = S_gone * np.outer(free, free), g_gone * free
    h = g_gone + S_gone @ step
    shared = of_gone * free + common @ S_gone
    variance = S_gone + excess(gone) + S_gone @ covariance @ S_gone + shared.T @ shared
    said = np.diag(S_gone) > UNTOUCHED * np.diag(S)
    h, variance = h[said], variance[np.ix_(said, said)]
    scale = 1 / np.sqrt(np.diag(variance))
    values, vectors = np.linalg.eigh(variance * np.outer(scale, scale))
    kept = values > 1e-8 * values[-1] if len(values) else values > 0
    statistic = float(np.sum((vectors[:, kept].T @ (scale * h)) ** 2 / values[kept]))
    dof = int(kept.sum())
    return Deletion(step, covariance, common, statistic, dof, chi2_sf(statistic, dof))


def _low(eq: Equations, k: int) -> FloatArray:
    """(V, parts, q) of an error that was taken, the units eliminated."""
    taken, own = eq.taken[k], eq.rows
    on_unit = eq.base.unit_solved(taken.units)[own.unit_of_part]
    through = np.einsum("vpd,vpdq->vpq", own.low_unit, on_unit)
    return np.where(taken.where[:, None, None], own.low[:, :, taken.columns], 0.0) - through


def _without(eq: Equations, gone: BoolArray) -> NormalEquations:
    """The equations without the rows of the views `gone`; units that lose all of them are held by a little."""
    units, base = eq.rows.units, eq.base
    part = eq.part(np.flatnonzero(gone))
    emptied = np.setdiff1d(units[gone], units[~gone])
    V = base.V - part.V
    V[emptied] += HELD_BY * np.eye(base.pattern.size)
    return replace(
        base,
        U=base.U - part.U,
        W=tuple(W - own for W, own in zip(base.W, part.W, strict=True)),
        V=V,
        gradient=base.gradient - part.gradient,
        unit_gradient=base.unit_gradient - part.unit_gradient,
    )


def _reduced(eq: Equations, part: NormalEquations, views: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Reduced `part`, the equations of views (V,) bool, and its gradient, with the errors that were taken."""
    own = eq.rows
    S, g = part.reduced, part.reduced_gradient
    if not eq.taken:
        return S, g
    crosses, units, gradients = [], [], []
    for taken in eq.taken:
        mine = np.flatnonzero(taken.where & views)
        cross = np.zeros((len(g), len(taken.columns)))
        np.add.at(cross, own.index[mine], own.by_globals[mine][:, taken.columns].transpose(0, 2, 1))
        of_units = np.zeros_like(taken.units)
        np.add.at(of_units, own.units[mine], own.by_unit[mine][:, :, taken.columns].transpose(0, 1, 3, 2))
        crosses.append(cross)
        units.append(of_units)
        gradients.append(own.score[mine][:, taken.columns].sum(axis=0))
    cross, of_units, gradient = (
        np.concatenate(crosses, axis=1),
        np.concatenate(units, axis=2),
        np.concatenate(gradients),
    )
    for WV, members, at in zip(part.WV, part.pattern.units, part.pattern.columns, strict=True):
        cross[at] -= np.einsum("npd,ndq->pq", WV, of_units[members], optimize=True)
    grams = [
        [own.gram[a.where & b.where & views][:, a.columns[:, None], b.columns].sum(axis=0) for b in eq.taken]
        for a in eq.taken
    ]
    solved = part.unit_solved(of_units)
    corner = np.block(grams) - np.einsum("fdp,fdq->pq", of_units, solved, optimize=True)
    gradient = gradient - np.einsum("fdq,fd->q", solved, part.unit_gradient)
    return np.block([[S, cross], [cross.T, corner]]), np.concatenate([g, gradient])


def hold_out(eq: Equations, params: SelfCheckParams) -> list[HeldOut]:
    """Parts in time held out in turn: the solution without them against what they say."""
    present = np.unique(eq.time_index[eq.shared & (eq.time_index != ALONE)])
    whole = delete(eq, np.zeros(len(eq.camera), bool))
    parts = []
    for part in np.array_split(present, params.folds):
        if len(part) < params.min_side or len(present) - len(part) < params.min_side:
            continue
        gone = eq.shared & np.isin(eq.time_index, part)
        held = delete(eq, gone)
        shared = held.common - whole.common
        square, noise = _moved_by(eq, held.step, held.covariance - whole.covariance + shared.T @ shared, gone)
        parts.append((eq.frames[part[0]], eq.frames[part[-1]], held, square, noise))
    out = []
    for first, last, held, square, noise in parts:
        rest = [own for _, _, own, _, _ in parts if own is not held]
        dof = sum(own.dof for own in rest)
        others = max(1.0, sum(own.statistic for own in rest) / dof) if dof else 1.0
        ratio = held.statistic / max(held.dof, 1) / others
        chance = f_sf(ratio, held.dof, dof) if others > 1 else held.p
        moves_mm = 1e3 * float(np.sqrt(max(square - others * noise, 0.0)))
        out.append(HeldOut(first, last, held.statistic, held.dof, others, chance, moves_mm))
    return out


def held_out_findings(
    rows: Sequence[HeldOut], params: SelfCheckParams, n_tests: int, stated_mm: float
) -> list[Finding]:
    """What is said of parts that do not fit."""
    limit = params.significance / (n_tests + params.folds)
    return [
        Finding(
            "held out",
            "distrust" if row.moves_mm > max(params.distrust_mm, stated_mm) else "caution",
            (),
            f"Calibrated without the frames {row.first} to {row.last}, the cameras put the board in them {row.moves_mm:.1f} mm "
            "apart, beyond what the covariance allows: these frames and the others are not of one rig",
            "Calibrate each part of the recording by itself and compare; record again where they differ",
            round(row.moves_mm, 3),
            row.p,
        )
        for row in rows
        if row.p < limit and row.moves_mm > max(params.caution_mm, stated_mm)
    ]


def _moved_by(eq: Equations, step: FloatArray, covariance: FloatArray, gone: BoolArray) -> tuple[float, float]:
    """Mean square of what a step of the globals moves the held-out corners by, and of its own noise, square metres.

    Each frame's board follows as well as it can: what is left is how far cameras then put one board apart.
    """
    P = len(eq.free)
    views: IntArray = np.flatnonzero(gone)
    left = eq.part_in_metres(views).reduced * np.outer(eq.free, eq.free)
    corners = max(int(eq.corners[gone].sum()), 1)
    return float(step[:P] @ left @ step[:P]) / corners, float(np.sum(left * covariance[:P, :P])) / corners

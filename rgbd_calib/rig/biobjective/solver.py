"""Levenberg-Marquardt on the reduced camera system (eq. A9 - A11 of the paper).

(S + lambda diag(U)) xi = g, poses updated as Exp(xi) T (left, in the world), the points eliminated by the terms. The
cost is the sum of the terms' own, each already divided by its sigma^2, so that it is dimensionless.

References
----------
K. Madsen, H. Nielsen, O. Tingleff, Methods for non-linear least squares problems, 2nd edition, section 3.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg import lapack

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.biobjective.moments import MomentTerm
from rgbd_calib.rig.biobjective.terms import PointTerm

Status = Literal["converged", "stalled", "iteration_limit", "round_limit"]
Term = PointTerm | MomentTerm

_FIRST_DAMPING = 1e-6
"""The start is triangulated from poses that are good to a few degrees: nearly a Gauss-Newton step."""

_LEAST_DAMPING = 1e-12
_MOST_DAMPING = 1e12


@dataclass(frozen=True)
class RefinementState:
    """Poses (N, 4, 4), world from camera, and the latent points (3, h) of each term (an empty array where none)."""

    T: FloatArray
    points: tuple[FloatArray, ...]


@dataclass(frozen=True)
class RefinementMinimum:
    """Where the solver stopped, and why."""

    state: RefinementState
    cost: float
    iterations: int
    status: Status
    message: str


@dataclass(frozen=True)
class _Step:
    xi: FloatArray
    points: tuple[FloatArray, ...]
    predicted: float


def evaluate(terms: Sequence[Term], state: RefinementState) -> float:
    """Cost at a state; leaves the terms ready for their normal equations there."""
    return sum(
        term.evaluate(state.T) if isinstance(term, MomentTerm) else term.evaluate(state.T, X)
        for term, X in zip(terms, state.points, strict=True)
    )


def minimize(
    terms: Sequence[Term], start: RefinementState, free_scale: bool, tolerance: float, max_iterations: int
) -> RefinementMinimum:
    """Least cost from a start with finite cost; camera 0 stays where it is.

    Parameters
    ----------
    free_scale : pixels alone: the step keeps the mean square distance of the cameras from camera 0 (the gauge).
    tolerance : relative decrease of the cost, promised by the linear model or seen, at which to stop.
    """
    state, cost = start, evaluate(terms, start)
    damping, growth, before = _FIRST_DAMPING, 2.0, 0.0
    for iteration in range(1, max_iterations + 1):
        step = _solve(terms, state, damping, free_scale)
        trial_cost, trial = float("inf"), state
        if step is not None:
            trial = _move(state, step, free_scale)
            trial_cost = evaluate(terms, trial)
            small = step.predicted <= tolerance * cost
            if trial_cost <= cost:
                decrease = cost - trial_cost
                good = decrease > 0.25 * step.predicted
                # steps that shrink by a factor leave about that factor times the last one
                left = step.predicted**2 / before if good and step.predicted < 0.1 * before else step.predicted
                state, cost, before = trial, trial_cost, step.predicted
                if small or left <= tolerance * cost or (good and decrease <= tolerance * cost):
                    return RefinementMinimum(
                        state,
                        cost,
                        iteration,
                        "converged",
                        f"the last step gained {decrease:.1e} of a cost of {cost:.6g}",
                    )
                damping, growth = (max(damping / 10, _LEAST_DAMPING) if good else damping * 2), 2.0
                continue
            if small:
                evaluate(terms, state)
                return RefinementMinimum(state, cost, iteration, "converged", "no step lowers the cost beyond rounding")
        evaluate(terms, state)
        damping, growth = damping * growth * 5, growth * 2
        if damping > _MOST_DAMPING:
            return RefinementMinimum(state, cost, iteration, "stalled", "no step lowers the cost, however short")
    return RefinementMinimum(
        state, cost, max_iterations, "iteration_limit", f"stopped after {max_iterations} iterations, still falling"
    )


def gauge_direction(T: FloatArray) -> FloatArray:
    """Unit direction (6 F,) in which poses (N, 4, 4) scale about camera 0; pixels do not see it."""
    n = np.concatenate([np.zeros((len(T) - 1, 3)), T[1:, :3, 3] - T[0, :3, 3]], axis=1).ravel()
    direction: FloatArray = n / np.linalg.norm(n)
    return direction


def _solve(terms: Sequence[Term], state: RefinementState, damping: float, free_scale: bool) -> _Step | None:
    """Damped step from the terms' state; None where the matrix is not positive definite."""
    size = 6 * (len(state.T) - 1)
    S, g, U, gain = np.zeros((size, size)), np.zeros(size), np.zeros(size), 0.0
    for term in terms:
        if isinstance(term, MomentTerm):
            S_term, g_term = term.normal()
            U_term = np.diag(S_term)
        else:
            S_term, g_term, U_term, gain_term = term.normal(damping)
            gain += gain_term
        S += S_term
        g += g_term
        U += U_term
    if free_scale:
        n = gauge_direction(state.T)
        S += U.max() * n[:, None] * n
    S[np.diag_indices(size)] += damping * U
    _, xi, failed = lapack.dposv(S, g, lower=1)
    if failed or not np.isfinite(gain):
        return None
    points = tuple(
        X if isinstance(term, MomentTerm) else term.step(xi) for term, X in zip(terms, state.points, strict=True)
    )
    return _Step(xi, points, float(xi @ g) + gain)


def _move(state: RefinementState, step: _Step, free_scale: bool) -> RefinementState:
    T = state.T.copy()
    T[1:] = se3.retract(state.T[1:], step.xi.reshape(-1, 6))
    points = tuple(X + dX for X, dX in zip(state.points, step.points, strict=True))
    if free_scale:
        origin = T[0, :3, 3].copy()
        size_before, size = (np.linalg.norm(P[:, :3, 3] - origin) for P in (state.T, T))
        T[:, :3, 3] = origin + (T[:, :3, 3] - origin) * (size_before / size)
        points = tuple(origin[:, None] + (X - origin[:, None]) * (size_before / size) for X in points)
    return RefinementState(T, points)

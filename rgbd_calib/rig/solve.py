"""Levenberg-Marquardt on a problem, the units eliminated (:mod:`rgbd_calib.geometry.linear`), and its covariances."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry.linear import Covariance, NormalEquations
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Kind, Scope
from rgbd_calib.rig.pose_rows import pose_rows
from rgbd_calib.rig.problem import Problem, State
from rgbd_calib.rig.weights import N_PIXEL

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING, FACTOR = 1e-4, 1e-12, 1e10, 8.0


class Status(Enum):
    CONVERGED = "the cost and the step no longer change"
    MAX_ITERATIONS = "the largest number of iterations was reached before the cost settled"


@dataclass(frozen=True)
class Minimum:
    state: State
    cost: float
    """Half the weighted sum of squares, priors included."""
    iterations: int
    status: Status


def minimize(problem: Problem, state: State, max_iterations: int, tolerance: float) -> Minimum:
    """The state of least cost for fixed weights.

    Raises
    ------
    CalibrationError
        The equations are singular at the start.
    """
    best, damping = problem.cost(state), FIRST_DAMPING
    for iteration in range(1, max_iterations + 1):
        equations = problem.equations(state)
        while True:
            step = equations.step(problem.prior.free, damping)
            trial = problem.moved(state, *step) if step is not None else state
            now = problem.cost(trial) if step is not None else np.inf
            if np.isfinite(now) and now <= best and problem.in_front(trial):
                break
            damping *= FACTOR
            if damping > MOST_DAMPING:
                if step is None:
                    raise CalibrationError(
                        "the bundle's equations are singular. Are all cameras joined by common views, and is any board pose "
                        "seen whole? Film more common views"
                    )
                return Minimum(state, best, iteration, Status.CONVERGED)
        gain = best - now
        state, best, damping = trial, now, max(damping / FACTOR, LEAST_DAMPING)
        if gain <= tolerance * best:
            return Minimum(state, best, iteration, Status.CONVERGED)
    return Minimum(state, best, max_iterations, Status.MAX_ITERATIONS)


def covariance(problem: Problem, state: State) -> Covariance:
    """Of all unknowns at a minimum.

    Raises
    ------
    CalibrationError
        The equations are singular.
    """
    equations = problem.equations(state)
    try:
        return equations.covariance(problem.prior.free)
    except np.linalg.LinAlgError:
        raise CalibrationError(_undetermined(problem, equations)) from None


def _undetermined(problem: Problem, equations: NormalEquations) -> str:
    """Which unknowns singular equations do not determine, for people: those of the least eigenvalue."""
    free = np.flatnonzero(problem.prior.free)
    A = equations.reduced[np.ix_(free, free)]
    scale = 1 / np.sqrt(np.maximum(np.abs(np.diag(A)), 1e-300))
    worst = int(free[np.argmax(np.abs(np.linalg.eigh(A * np.outer(scale, scale))[1][:, 0]))])
    block = next(b for b in problem.blocks if worst < problem.parts[b.name].stop)
    camera, what = problem.setup.cameras[(worst - problem.parts[block.name].start) // block.n], block.name
    if block.scope is not Scope.CAMERA:
        return f"the recording does not determine the {what} (singular equations). Film more common views"
    if Kind.PIXEL in block.kinds:
        return f"the recording does not determine {camera}'s {what} (singular equations). Film more common views of {camera}"
    return (
        f"{camera}'s depth does not follow the board (singular equations of its {what}). Check that its depth images are of the "
        "same instants as its colour images, of this camera, and in the unit that is stated"
    )


def sandwich_covariance(problem: Problem, state: State, plain: Covariance) -> FloatArray:
    """Covariance (P, P) of the globals where pose parts are noisier than they are weighed.

    The estimate solves A step = -g, while g has the covariance A + sum_i e_i q_i q_i', e_i the excess of the variance of pose
    part i of the pixels and q_i its row: Cov = A^-1 + sum_i e_i (A^-1 q_i)(A^-1 q_i)' (H. White, Econometrica 48(4), 1980).
    """
    carried = pose_rows(problem, state).carried(plain, problem)[0][:, :N_PIXEL]
    more = carried * np.sqrt(problem.weights.excess_pixel)[:, None]
    flat = more.reshape(-1, more.shape[-1])
    return np.asarray(plain.of_globals + flat.T @ flat)

"""The self-checks of a carried board: their algebra on banded equations against dense least squares, silence, and causes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from carried_board import carried, filmed

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.motion.estimate import estimate
from rgbd_calib.rig.motion.problem import MotionProblem
from rgbd_calib.rig.setup import BundleParams
from rgbd_calib.rig.solution import Solution
from rgbd_calib.trust.self_check import Equations, Finding, SelfCheckParams, delete, findings_of, outcomes_of
from rgbd_calib.trust.self_check.of_solution import equations_of, held_blocks

FEW = BundleParams(hold=("depth field", "corner offsets", "registration"))
PARAMS = SelfCheckParams()


def in_time(session) -> list[str]:
    views = sorted(session.views, key=lambda v: session.t_s[v.camera][v.frame])
    return [f"{v.camera} {v.frame}" for v in views]


def findings(session, found: Solution) -> list[Finding]:
    held = held_blocks(found.problem)
    eq = equations_of(found, held, in_time(session))
    return findings_of(eq, outcomes_of(eq, found.problem, held, PARAMS), PARAMS, 0.0)[0]


@pytest.fixture(scope="module")
def solved():
    session, rng = filmed(5, seconds=4.0, rate_hz=12.0, readout_s=0.0)
    return session, estimate(**carried(session, rng), params=FEW)


def dense(found: Solution, eq: Equations) -> tuple[FloatArray, FloatArray, FloatArray]:
    """J of the globals and knots, priors' rows below, what is left, and the view of each row, times the root of the weight
    matrix; priors have view -1."""
    problem, state = found.problem, found.state
    assert isinstance(problem, MotionProblem)
    P, n = problem.n_globals, problem.own.n_windows
    K = 6 * (n + 3)
    blocks, left, of_view = [], [], []
    for some, look, rows in problem.rows(state):
        J_rows, J_unit, r = rows.flat()
        Q, ratio = problem.weights.parts(look.kind)
        for k, v in enumerate(some):
            J = np.zeros((J_rows.shape[1], P + K))
            J[:, rows.columns] = J_rows[k]
            first = P + 6 * rows.units[k]
            J[:, first : first + 24] = J_unit[k]
            used = np.any(J != 0, axis=1)
            root = np.eye(len(J)) - Q[v] * (1 - 1 / ratio) @ Q[v].T
            blocks.append((root @ J)[used])
            left.append((root @ r[k])[used])
            of_view.append(np.full(int(used.sum()), v))
    r, J_jerk = state.boards.spline.jerks()  # type: ignore[attr-defined]
    w = 1 / problem.jerk_scale()
    for k in range(n):
        J = np.zeros((6, P + K))
        J[:, P + 6 * k : P + 6 * k + 24] = J_jerk[k] * w[:, None]
        blocks.append(J)
        left.append(r[k] * w)
    values, vectors = np.linalg.eigh(problem.prior.information)
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    blocks.append(np.hstack([root, np.zeros((P, K))]))
    left.append(root @ (problem.vector(state) - problem.prior.mean))
    of_view.append(np.full(6 * n + P, -1))
    free = np.concatenate([problem.prior.free, np.ones(K, bool)])
    return np.vstack(blocks) * free, np.concatenate(left), np.concatenate(of_view)


def solution(J: FloatArray, right: FloatArray) -> FloatArray:
    """Least squares of columns of any units."""
    scale = np.maximum(np.linalg.norm(J, axis=0), 1e-12)
    return np.asarray(np.linalg.lstsq(J / scale, right, rcond=1e-12)[0] / scale)


def test_the_score_is_that_of_dense_equations(solved):
    """An error of C2's depth delay from half-way on, whose column the block itself gives."""
    session, found = solved
    eq = equations_of(found, held_blocks(found.problem), in_time(session))
    J, r, of_view = dense(found, eq)
    where = (eq.camera == 1) & (eq.time_index > np.median(eq.time_index))
    column = eq.columns["clock"].start
    projected = eq.project(np.array([column]), where)
    late = np.isin(of_view, np.flatnonzero(where))
    A = J[:, found.problem.index("clock", 1)[0]] * late
    M = A - J @ solution(J, A)
    assert projected.information[0, 0] == pytest.approx(M @ M, rel=1e-6)
    assert projected.score[0] == pytest.approx(M @ r, abs=1e-3 * np.linalg.norm(M))


def test_frames_held_out_by_formula_and_by_dense_equations(solved):
    session, found = solved
    eq = equations_of(found, held_blocks(found.problem), in_time(session))
    J, r, of_view = dense(found, eq)
    gone = eq.time_index < np.quantile(eq.time_index, 0.25)
    kept = ~np.isin(of_view, np.flatnonzero(gone))
    step = -solution(J[kept], r[kept])[: found.problem.n_globals]
    held = delete(replace(eq, excess=np.zeros_like(eq.excess)), gone)
    sd = np.sqrt(np.maximum(np.diag(held.covariance), 1e-30))
    assert np.abs((held.step - step) / sd)[eq.free].max() < 1e-2


def test_nothing_is_said_of_a_good_recording(solved):
    assert findings(*solved) == []


def test_a_clock_that_jumps_is_named():
    session, rng = filmed(6, seconds=4.0, rate_hz=12.0)
    stamps = dict(session.stamps_us["C2"])
    for frame in list(stamps)[len(stamps) // 2 :]:
        stamps[frame] = (stamps[frame][0] + 15e3, stamps[frame][1] + 15e3)
    spoiled = replace(session, stamps_us={**session.stamps_us, "C2": stamps})
    first = findings(session, estimate(**carried(spoiled, rng), params=FEW))[0]
    assert first.check == "clock over time"  # of two cameras, either may have jumped
    assert "C2's timestamps jumped by +1" in first.text or "C1's timestamps jumped by -1" in first.text

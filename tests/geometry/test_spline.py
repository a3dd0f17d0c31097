"""The spline of rigid motions, and equations whose units are its windows, against differences and dense algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.banded import BAND, SIZE, BandedEquations
from rgbd_calib.geometry.linear import Pattern, Rows, assemble
from rgbd_calib.geometry.spline import Spline, inverse_right_jacobian, right_jacobian, through

STEP = 1e-5


@pytest.fixture
def path() -> Spline:
    rng = np.random.default_rng(0)
    R = so3.exp(np.cumsum(rng.normal(0, 0.2, (9, 3)), axis=0))
    return Spline(1.0, 0.1, R, np.cumsum(rng.normal(0, 0.1, (9, 3)), axis=0), np.array([0.2, 0.1, 0.0]))


T_S = np.array([1.1, 1.137, 1.25, 1.31, 1.444, 1.6999])


def left_motion(after, before, at):
    """Derivative of the left motion, from poses one step after and before."""
    return (se3.difference(after, at) - se3.difference(before, at)) / (2 * STEP)


def test_jacobians_of_the_exponential():
    for v in (np.array([0.3, -0.2, 0.5]), np.array([2e-5, 1e-5, 0.0])):
        J = np.stack([so3.log(so3.exp(v).T @ so3.exp(v + STEP * e)) / STEP for e in np.eye(3)], axis=1)
        np.testing.assert_allclose(right_jacobian(v), J, atol=2e-6)
        np.testing.assert_allclose(inverse_right_jacobian(v) @ right_jacobian(v), np.eye(3), atol=1e-12)


def test_velocity_and_acceleration_are_those_of_the_poses(path):
    now, later, before = path.at(T_S), path.at(T_S + STEP), path.at(T_S - STEP)
    np.testing.assert_allclose(now.twist, left_motion(later.T, before.T, now.T), atol=1e-6)
    inside = slice(1, 5)  # the third derivative jumps at the knots
    for value, rate in (("omega", "alpha"), ("velocity", "acceleration")):
        difference = (getattr(later, value) - getattr(before, value)) / (2 * STEP)
        np.testing.assert_allclose(getattr(now, rate)[inside], difference[inside], atol=1e-4)


def test_derivatives_by_the_knots(path):
    place = path.at(T_S)
    J = place.by_knots()
    for k in range(4):
        for d in range(6):
            steps = np.zeros((len(T_S), len(path.R), 6))
            for i, w in enumerate(place.window):
                steps[i, w + k, d] = STEP
            for i, t in enumerate(T_S):
                moved = [path.moved(sign * steps[i]).at(np.array([t])).T[0] for sign in (1, -1)]
                np.testing.assert_allclose(J[i, :, 6 * k + d], left_motion(*moved, place.T[i]), atol=1e-7)


def test_derivatives_of_the_jerk(path):
    J = path.jerks()[1]
    rng = np.random.default_rng(1)
    step = rng.normal(0, 1, (len(path.R), 6))
    up, down = (path.moved(sign * STEP * step).jerks()[0] for sign in (1, -1))
    windows = np.stack([step[w : w + 4].ravel() for w in range(path.n_windows)])
    np.testing.assert_allclose((up - down) / (2 * STEP), np.einsum("wij,wj->wi", J, windows), atol=1e-6)


def test_a_spline_through_poses_is_near_them(path):
    t = np.arange(1.1, 1.7, 0.02)
    again = through(t, path.at(t).T, path.middle_m, 0.05)
    left = se3.difference(again.at(t).T, path.at(t).T)
    assert np.abs(left).max() < 0.05  # a cubic B-spline is not interpolating
    assert again.windows(t)[0].min() >= 0 and again.windows(t)[1].max() < 1.0


def random_equations(n_windows=7, n_others=2, P=5, seed=2) -> BandedEquations:
    rng = np.random.default_rng(seed)
    F = n_windows + n_others
    pattern = Pattern.of([(0,)] * F, {(0,): np.arange(P)}, P, BAND)
    n = 10 * F
    units = np.arange(n) % F
    rows = Rows(
        units,
        np.arange(P),
        rng.normal(size=(n, 3, 2, P)),
        rng.normal(size=(n, 3, 2, BAND)),
        rng.normal(size=(n, 3, 2)),
        np.zeros((n, 3, 0), int),
        np.zeros((n, 3, 2, 0)),
    )
    own = assemble(pattern, [rows])
    return BandedEquations(own.pattern, own.U, own.W, own.V, own.gradient, own.unit_gradient, own.curvature, n_windows)


def dense(eq: BandedEquations) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """All of it as one matrix: globals, knots, others; the right side; and where each unit's unknowns are."""
    P, K = eq.pattern.n_globals, eq.n_knots
    at = [P + SIZE * w + np.arange(BAND) for w in range(eq.n_windows)]
    at += [P + SIZE * K + BAND * k + np.arange(BAND) for k in range(eq.pattern.n_units - eq.n_windows)]
    n = at[-1][-1] + 1
    A, b = np.zeros((n, n)), np.zeros(n)
    A[:P, :P], b[:P] = eq.U, eq.gradient
    for u, own in enumerate(at):
        A[np.ix_(own, own)] += eq.V[u]
        A[:P, own] += eq.W[0][u]
        A[own, :P] += eq.W[0][u].T
        b[own] += eq.unit_gradient[u]
    return A, b, at


def test_banded_equations_are_the_dense_ones():
    eq = random_equations()
    A, b, at = dense(eq)
    P, free = eq.pattern.n_globals, np.ones(eq.pattern.n_globals, bool)
    x = -np.linalg.solve(A, b)
    step, unit_step = eq.step(free, 0.0)
    np.testing.assert_allclose(step, x[:P], atol=1e-9)
    np.testing.assert_allclose(unit_step, np.stack([x[own] for own in at]), atol=1e-9)
    C, cov = np.linalg.inv(A), eq.covariance(free)
    np.testing.assert_allclose(cov.of_globals, C[:P, :P], atol=1e-10)
    np.testing.assert_allclose(cov.of_units, np.stack([C[np.ix_(own, own)] for own in at]), atol=1e-10)
    np.testing.assert_allclose(cov.cross(np.arange(len(at))), np.stack([C[:P, own] for own in at]), atol=1e-10)
    assert cov.trace(eq) == pytest.approx(len(A), abs=1e-8)
    V_inv = np.linalg.inv(A[P:, P:])
    right = np.random.default_rng(0).normal(size=(len(at), BAND, 3))
    flat = np.zeros((len(A) - P, 3))
    for own, values in zip(at, right, strict=True):
        flat[own - P] += values
    solved = V_inv @ flat
    np.testing.assert_allclose(eq.unit_solved(right), np.stack([solved[own - P] for own in at]), atol=1e-9)


@pytest.mark.parametrize("gap", [10, 32, 80])
@pytest.mark.parametrize("jerk", [1e-2, 1e-4])
def test_covariance_over_windows_without_a_view(gap, jerk):
    """The prior alone holds these knots: 80 of 50 ms are 4 s for which no camera sees the board."""
    rng = np.random.default_rng(0)
    n = gap + 40
    V = np.zeros((n, BAND, BAND))
    third = np.kron([-1.0, 3.0, -3.0, 1.0], np.eye(SIZE)) / jerk
    V += third.T @ third
    for w in (*range(20), *range(n - 20, n)):
        J = rng.normal(0, 300.0, (12, BAND))
        V[w] += J.T @ J
    pattern = Pattern.of([(0,)] * n, {(0,): np.arange(1)}, 1, BAND)
    eq = BandedEquations(
        pattern, np.eye(1), (np.zeros((n, 1, BAND)),), V, np.zeros(1), np.zeros((n, BAND)), np.zeros(1), n
    )
    A, _, at = dense(eq)
    C = np.linalg.inv(A)
    sd = np.sqrt(np.diag(C))
    left = np.stack(
        [(block - C[np.ix_(own, own)]) / np.outer(sd[own], sd[own]) for block, own in zip(eq.V_inv, at, strict=True)]
    )
    # rounding times the condition number, some 1e10 at most
    assert np.abs(left).max() < np.finfo(float).eps * np.linalg.cond(A)


def test_damping_is_that_of_the_knots():
    eq = random_equations()
    A, b, _ = dense(eq)
    P = eq.pattern.n_globals
    A[np.diag_indices(len(A))] *= 1.5
    step, _ = replace(eq, curvature=np.diag(eq.U)).step(np.ones(P, bool), 0.5)
    np.testing.assert_allclose(step, -np.linalg.solve(A, b)[:P], atol=1e-9)

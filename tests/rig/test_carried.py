"""The bundle of a carried board: derivatives, the minimum, clocks and their covariance, and what it reduces to."""

from __future__ import annotations

import numpy as np
import pytest
from carried_board import DEPTH_AT, carried, filmed, with_depth_cameras

from rgbd_calib.geometry import se3
from rgbd_calib.rig.motion.estimate import clock_of, estimate, problem_of
from rgbd_calib.rig.setup import BundleParams


@pytest.mark.parametrize("registered", [True, False])
def test_derivatives_agree_with_differences(registered):
    session, rng = filmed(0, seconds=1.5, readout_s=0.02)
    given = carried(session, rng, every=6)
    given = given if registered else with_depth_cameras(given, session, rng)
    problem, state, _, _ = problem_of(**given, params=BundleParams())
    n_units = problem.pattern.n_units
    state = problem.moved(state, rng.normal(0, 1, problem.n_globals) * 1e-4, np.zeros((n_units, 24)))
    knots = rng.normal(0, 1, (problem.own.n_windows + 3, 6))
    units = np.zeros((n_units, 24))
    for w in range(problem.own.n_windows):
        units[w] = knots[w : w + 4].ravel()
    steps = {"knots": (np.zeros(problem.n_globals), units)}
    for name in ("clock", "depth delay", "readout", "pose", "intrinsics", "registration", "print"):
        step = np.zeros(problem.n_globals)
        step[problem.index(name)] = rng.normal(0, 1, len(problem.index(name))) * (name != "pose" or 1)
        steps[name] = (step * problem.prior.free, np.zeros((n_units, 24)))
    for name, (step, unit_step) in steps.items():
        h = 1e-5 if name != "intrinsics" else 1e-4
        up, down = (problem.moved(state, sign * h * step, sign * h * unit_step) for sign in (1, -1))
        ups, downs = (list(problem.rows(own)) for own in (up, down))
        for (_, look, rows), (_, _, a), (_, _, b) in zip(problem.rows(state), ups, downs, strict=True):
            difference, J = (a.r - b.r) / (2 * h), rows.moved(step, unit_step)
            # knots over the rows of the shutter: a series of second order; the print between colour and depth: not turned
            tolerance = 2e-3 if name in ("knots", "print") else 1e-4
            np.testing.assert_allclose(
                J, difference, atol=tolerance * max(1.0, np.abs(difference).max()), err_msg=f"{name} {look.kind}"
            )


def test_the_gradient_of_the_cost_is_that_of_the_equations():
    session, rng = filmed(1, seconds=1.5)
    problem, state, _, _ = problem_of(**carried(session, rng, every=4), params=BundleParams())
    eq = problem.equations(state)
    step, knots = rng.normal(0, 1e-5, problem.n_globals) * problem.prior.free, rng.normal(0, 1e-5, (eq.n_knots, 6))
    units = np.stack([knots[w : w + 4].ravel() for w in range(eq.n_windows)])
    up, down = (problem.cost(problem.moved(state, sign * step, sign * units)) for sign in (1, -1))
    expected = eq.gradient @ step + np.sum(eq.knots(eq.unit_gradient) * knots.ravel())
    assert (up - down) / 2 == pytest.approx(expected, rel=1e-4)


def test_the_delay_of_depth_that_is_not_registered_is_found():
    errors, nees = [], []
    for seed in range(3):
        session, rng = filmed(seed, seconds=3.0, rate_hz=10.0)
        given = with_depth_cameras(carried(session, rng), session, rng)
        found = estimate(**given, params=BundleParams(hold=("depth field", "corner offsets")))
        for c, truth in session.clocks.items():
            clock = clock_of(found, c)
            errors.append((clock.depth_delay_s - truth.depth_delay_s) / clock.depth_delay_sd_s)
            assert clock.depth_delay_sd_s < 0.003
            at = session.truth.cameras[c].T_world_color @ se3.retract(np.eye(4), DEPTH_AT)
            left = se3.difference(found.T_world_color(f"{c}/depth"), at)
            nees.append(left @ np.linalg.solve(found.pose_covariance(f"{c}/depth"), left) / 6)
    assert 0.3 < np.mean(nees) < 2.0
    assert 0.2 < np.mean(np.square(errors)) < 2.5  # six values of chi^2 over its degrees of freedom
    assert np.max(np.abs(errors)) < 3.5


@pytest.mark.parametrize(
    ("seed", "readout_s"),
    [
        (2, 0.02),
        *(pytest.param(seed, readout_s, marks=pytest.mark.slow) for seed in range(4) for readout_s in (0.0, 0.02)),
    ],
)
def test_clocks_are_found(seed, readout_s):
    session, rng = filmed(seed, seconds=3.0, rate_hz=15.0, readout_s=readout_s, drift_ppm=40.0)
    few = BundleParams(hold=("depth field", "corner offsets", "registration"))
    found = estimate(**carried(session, rng), params=few)
    for c, truth in session.clocks.items():
        clock = clock_of(found, c)
        if c != "C1":
            assert abs(clock.offset_s - truth.offset_s) < 4 * clock.offset_sd_s < 0.004
            assert abs(clock.drift_ppm - truth.drift_ppm) < 4 * clock.drift_sd_ppm
        assert abs(clock.depth_delay_s - truth.depth_delay_s) < 4 * clock.depth_delay_sd_s < 0.04
        assert abs(clock.readout_s - truth.readout_s) < (0.005 if readout_s else 1e-12)
    left = se3.difference(found.T_world_color("C2"), session.truth.cameras["C2"].T_world_color)
    assert left @ np.linalg.solve(found.pose_covariance("C2"), left) < 30  # chi^2 of 6: once in 25 000

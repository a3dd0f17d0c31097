"""The covariance that a size adds by being estimated, against the whole posterior of parameter and size."""

from __future__ import annotations

import numpy as np
import pytest

from rgbd_calib.rig.blocks.block import Component
from rgbd_calib.rig.unknown_sizes import SPAN, _beyond

USUAL = 0.01


@pytest.mark.parametrize("measured", [0.0, 0.004, 0.03])
@pytest.mark.parametrize("noise", [0.002, 0.02])
@pytest.mark.parametrize("dof", [0.001, 4.0])
def test_parameter_and_size_integrated_on_a_grid(measured, noise, dof):
    structure = 3.0
    s = np.geomspace(USUAL / SPAN, USUAL * SPAN, 401)[:, None]
    theta = np.linspace(-0.5, 0.5, 20001)
    log_p = -0.5 * ((theta - measured) / noise) ** 2 - 0.5 * structure * theta**2 / s**2 - np.log(s)
    log_p = log_p - 0.5 * dof * (2 * np.log(s) + USUAL**2 / s**2)
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    whole = np.sum(p * theta**2) - np.sum(p * theta) ** 2
    size = 0.004  # as an estimate may have it
    C = 1 / (1 / noise**2 + structure / size**2)
    component = Component("one", np.arange(1), np.array([[structure]]), USUAL, dof)
    own, theta = np.array([[C]]), np.array([C * measured / noise**2])
    more = _beyond(own, 1 / own, np.zeros((1, 1)), theta, component, size)[0, 0]
    assert more == pytest.approx(max(whole - C, 0.0), rel=0.02, abs=0.01 * C)


def test_what_nothing_shows_is_as_uncertain_as_it_may_be_large():
    nothing_seen = 1e-5  # the size to which shapes go that no data show
    C = nothing_seen**2 * (1 - 1e-9) * np.eye(2)
    component = Component("field", np.arange(2), np.eye(2), USUAL, 0.001, 5 * USUAL)
    more = _beyond(C, np.linalg.inv(C), np.zeros((2, 2)), np.zeros(2), component, nothing_seen)
    sizes = np.geomspace(USUAL / SPAN, 5 * USUAL, 20001)
    assert np.diag(more) == pytest.approx(np.mean(sizes**2), rel=0.03)
    assert abs(more[0, 1]) < 1e-9 * more[0, 0]


def test_parameters_that_are_known_to_be_zero_tell_nothing_of_the_size():
    C, theta, size = np.diag([4e-6, 9e-6]), np.array([0.003, -0.001]), 0.004
    held = np.linalg.inv(np.diag([4e-6, 9e-6, 1e-14, 1e-14]))
    known = np.diag([0.0, 0.0, 1e14, 1e14])
    two, four = (Component("some", np.arange(k), np.eye(k), USUAL, 0.001) for k in (2, 4))
    alone = _beyond(C, np.linalg.inv(C), np.zeros((2, 2)), theta, two, size)
    among = _beyond(np.linalg.inv(held), held, known, np.append(theta, [0.0, 0.0]), four, size)
    assert among[:2, :2] == pytest.approx(alone, rel=1e-6, abs=1e-12)

"""The fine pattern of a depth sensor from walls: found where it is, nothing where there is only noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rgbd_calib.rig.local_field import POWERS, local_field

ROWS, COLUMNS = 30, 40
Z_M = np.linspace(0.6, 4.0, 10)


def walls(rng: np.random.Generator, pattern: np.ndarray, correlation_cells: float) -> tuple[np.ndarray, np.ndarray]:
    """Errors (walls, rows, columns) of a pattern of the disparity, with noise of 0.5 mm at 1 m that grows as z^2."""
    noise = rng.normal(0, 1, (len(Z_M), ROWS, COLUMNS))
    if correlation_cells:
        noise = gaussian_filter(noise, (0, correlation_cells, correlation_cells))
        noise /= noise.std()
    depth_m = np.broadcast_to(Z_M[:, None, None], noise.shape)
    return (pattern + 5e-4 * noise) * depth_m**2, depth_m


@pytest.mark.parametrize("correlation_cells", [0.0, 0.7])
def test_noise_is_not_taken_for_a_pattern(correlation_cells):
    rng = np.random.default_rng(0)
    left_m, depth_m = walls(rng, np.zeros((ROWS, COLUMNS)), correlation_cells)
    found = None
    for _ in range(5):  # as between the rounds of a bundle
        found = local_field(left_m, depth_m, np.ones_like(left_m, bool), found)
    assert found is not None and found.powers == POWERS
    at_3_m = sum(values * 3.0**power for power, values in zip(found.powers, found.values, strict=True))
    # ten walls would leave 4.5 mm / sqrt(10) = 1.4 mm if all were believed
    assert at_3_m.std() < 0.05e-3
    assert found.variance_m2(np.array([3.0]))[0] < (0.1e-3) ** 2


def test_a_pattern_is_found_and_its_error_is_stated():
    rng = np.random.default_rng(1)
    true = 1e-3 * np.sign(np.sin(np.arange(COLUMNS) * 1.1) * np.cos(np.arange(ROWS)[:, None] * 1.3))  # cells with steps
    left_m, depth_m = walls(rng, true, 0.5)
    seen = rng.random(left_m.shape) > 0.1
    found = local_field(np.where(seen, left_m, 0.0), depth_m, seen)
    assert found is not None
    at_3_m = sum(values * 3.0**power for power, values in zip(found.powers, found.values, strict=True))
    error_m = at_3_m - 9 * true
    assert (9 * true).std() == pytest.approx(9e-3, rel=0.02)
    assert error_m.std() < 2.5e-3
    assert error_m.std() == pytest.approx(np.sqrt(found.variance_m2(np.array([3.0]))[0]), rel=0.5)


def test_too_few_walls_show_none():
    left_m, depth_m = walls(np.random.default_rng(2), np.zeros((ROWS, COLUMNS)), 0.0)
    assert local_field(left_m[:3], depth_m[:3], np.ones((3, ROWS, COLUMNS), bool)) is None

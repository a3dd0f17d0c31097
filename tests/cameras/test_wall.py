"""The distance to a wall: tilts, steps of the disparity, furniture, correlated noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rgbd_calib.cameras.wall import depth_at, wall_cells

W, H, F = 320, 240, 280.0
CENTRE = (158.3, 121.9)
V, U = np.mgrid[0:H, 0:W]


def wall_depth(depth_m: np.ndarray, centre_px: tuple[float, float]) -> tuple[float, float]:
    return depth_at(wall_cells(depth_m), centre_px)


def wall(z_m: float, tilt_u: float = 0.0, tilt_v: float = 0.0) -> np.ndarray:
    """Depth image (H, W), metres, of a plane at `z_m` on the optical axis with these slopes of z by x and by y."""
    return z_m / (1 - tilt_u * (U - CENTRE[0]) / F - tilt_v * (V - CENTRE[1]) / F)


@pytest.mark.parametrize("z_m", [0.6, 1.7, 3.2])
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.15, -0.1)])
def test_exact_on_a_plane(z_m, tilt):
    found_m, error_m = wall_depth(wall(z_m, *tilt), CENTRE)
    assert found_m == pytest.approx(z_m, abs=1e-9)
    assert error_m < 1e-6


@pytest.mark.parametrize("seed", range(10))
def test_noise_within_its_standard_error(seed):
    rng = np.random.default_rng(seed)
    # correlated over 5 px, as a matching window makes it
    noise = gaussian_filter(rng.normal(0, 1, (H, W)), 2.5)
    z = wall(2.0, 0.05, 0.02) + 0.004 * noise / noise.std()
    found_m, error_m = wall_depth(z, CENTRE)
    assert abs(found_m - 2.0) < 5 * error_m
    # 36 patches of 32 x 24 px hold about 768 / (4 pi 2.5^2) = 10 independent values each: 4 mm / sqrt(350) = 0.2 mm
    assert 0.1e-3 < error_m < 0.4e-3


@pytest.mark.parametrize("z_m", np.linspace(2.9, 3.1, 9))
@pytest.mark.parametrize("tilt", [0.0, 0.004])
def test_steps_of_the_disparity(z_m, tilt):
    """At 3 m an eighth of a pixel of disparity is 26 mm: most of the wall shares one step."""
    rng = np.random.default_rng(0)
    scale = 1 / 0.0029  # 1/8 px of 43.1 = f b
    z = wall(z_m, tilt) + rng.normal(0, 1, (H, W)) * 0.012
    z = scale / np.round(scale / z)
    found_m, _ = wall_depth(z, CENTRE)
    # noise of half a step dithers it: the mean of the steps is that of the wall but for exp(-2 pi^2 0.46^2) = 1.5 % of a
    # step over pi, 0.13 mm; noise of 12 mm over 27 000 px, 0.07 mm. 1 mm holds both five times
    assert abs(found_m - z_m) < 1e-3


def test_furniture_and_holes_do_not_matter():
    rng = np.random.default_rng(0)
    z = wall(2.5, 0.03) + rng.normal(0, 0.003, (H, W))
    z[:, :90] = 1.4  # a cupboard, a third of the used part's left side
    z[190:, :] = 2.3  # a skirting board at its lower border, within 10 % of the wall
    z[rng.random((H, W)) < 0.2] = np.nan
    found_m, error_m = wall_depth(z, CENTRE)
    assert abs(found_m - 2.5) < 1e-3
    assert error_m < 1e-3


def test_too_little_of_the_wall_is_measured():
    z = np.full((H, W), np.nan)
    assert np.isnan(wall_depth(z, CENTRE)).all()
    z[:40, :] = 1.0  # only outside the part that is used
    assert np.isnan(wall_depth(z, CENTRE)).all()

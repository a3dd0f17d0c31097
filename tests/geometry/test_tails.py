"""Tail probabilities are those of scipy.stats."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from rgbd_calib.geometry.tails import chi2_isf, chi2_sf, f_sf


@pytest.mark.parametrize("x", [-1e-9, 0.0, 0.3, 7.0, 1e4, np.nan])
@pytest.mark.parametrize("dof", [0, 1, 2.5, 300])
def test_chi_squared_and_f_are_those_of_scipy(x: float, dof: float) -> None:
    assert chi2_sf(x, dof) == pytest.approx(float(stats.chi2.sf(x, dof)), rel=1e-10, nan_ok=True)
    for below in (0, 3, 1e6):
        assert f_sf(x, dof, below) == pytest.approx(float(stats.f.sf(x, dof, below)), rel=1e-8, nan_ok=True)


@pytest.mark.parametrize("p", [1e-4, 0.5, 0.99])
@pytest.mark.parametrize("dof", [1, 3.3, 300])
def test_what_chi_squared_exceeds_is_that_of_scipy(p: float, dof: float) -> None:
    assert chi2_isf(p, dof) == pytest.approx(float(stats.chi2.isf(p, dof)), rel=1e-10)

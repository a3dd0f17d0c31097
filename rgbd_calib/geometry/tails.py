"""Tail probabilities of chi squared and F by scipy.special: to import scipy.stats for them takes half a second."""

from __future__ import annotations

from scipy.special import chdtrc, chdtri, fdtrc


def chi2_sf(x: float, dof: float) -> float:
    """Chance that chi squared exceeds x; NaN without degrees of freedom."""
    return float(chdtrc(dof, max(x, 0.0))) if dof else float("nan")


def chi2_isf(p: float, dof: float) -> float:
    """What chi squared exceeds with chance p."""
    return float(chdtri(dof, p))


def f_sf(x: float, dof: float, dof_below: float) -> float:
    """Chance that F, of `dof` over `dof_below` degrees of freedom, exceeds x; NaN without either."""
    return float(fdtrc(dof, dof_below, max(x, 0.0)))

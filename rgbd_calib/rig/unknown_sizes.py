"""What variance components add to the covariance by being estimated: their sizes are not known exactly.

The estimate takes the most probable size of each component for true. Where few boards tell it, that is often far too small: shapes
of a depth field that nothing shows have the size zero, and a deviation of zero with it. By the law of total variance, with
theta a component's parameters, s its size, and all else of the data,

    Cov(theta) = E[Cov(theta | s)] + Cov(E[theta | s])

over the posterior of s (R. Kass, D. Steffey, JASA 84(407), 1989). The data say of theta, all other unknowns eliminated and
the other sizes as estimated, L theta = b +- L^(1/2), so that with R the structure of the prior

    Cov(theta | s) = (L + R / s^2)^-1,    E[theta | s] = (L + R / s^2)^-1 b
    ln p(b | s) = (b' (L + R / s^2)^-1 b - ln |1 + s^2 R^-1 L| + ln |1 + s^2 R^-1 K|) / 2 + const

with K, which is in L too, what else is known of theta before. These are sums in the basis where R is 1 and L diagonal. Before
the data, s is as likely on any scale, and as its component says. The other unknowns follow theta by their regression on it.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import eigh, eigvalsh

from rgbd_calib.geometry.linear import Covariance, symmetric_inverse
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Component
from rgbd_calib.rig.problem import Problem, State

SPAN = 30.0
"""Sizes from so much less than usual up to as much more, and to the most that there is."""
SIZES = 80


def covariance_of_sizes(problem: Problem, state: State, plain: Covariance) -> FloatArray:
    """(P, P), to be added to the covariance `plain` of the global parameters."""
    C, theta = plain.of_globals, problem.vector(state) - problem.prior.mean
    out = np.zeros_like(C)
    for index, component in problem.components:
        at, size = np.ix_(index, index), problem.weights.sizes[component.name]
        own, known = C[at], problem.prior.information[at] - component.structure / size**2
        information = symmetric_inverse(own)
        carried = information @ C[index]  # (k, P)
        more = _beyond(own, information, known, theta[index], component, size)
        out += carried.T @ more @ carried
    return out


def _beyond(
    C: FloatArray, information: FloatArray, known: FloatArray, theta: FloatArray, component: Component, size: float
) -> FloatArray:
    """(k, k): by how much the covariance of parameters exceeds C, which holds for one size; never negative.

    `information` is the inverse of C, `known` its part that is prior but not the component's.
    """
    R, usual2 = component.structure, component.usual**2
    value, basis = eigh(information - R / size**2, R)  # basis' R basis = 1
    value, pull = np.maximum(value, 0.0), basis.T @ information @ theta
    edges = np.geomspace(component.usual / SPAN, min(component.most, SPAN * component.usual), SIZES + 1)
    s2 = (edges[1:] * edges[:-1])[:, None]
    variance = s2 / (1 + s2 * value)  # (sizes, k)
    log_p = 0.5 * np.sum(variance * pull**2 - np.log1p(s2 * value), axis=1)
    log_p += 0.5 * np.sum(np.log1p(s2 * np.maximum(eigvalsh(known, R), 0.0)), axis=1)
    log_p -= 0.5 * component.dof * (np.log(s2) + usual2 / s2)[:, 0]
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    mean = variance * pull
    off = mean - p @ mean
    total = basis @ (np.diag(p @ variance) + (off.T * p) @ off) @ basis.T
    values, vectors = np.linalg.eigh(total - C)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)

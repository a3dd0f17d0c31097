"""The estimator: poses and sigmas in turn (section 6 of the paper), then what they are worth."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.geometry.tails import chi2_isf
from rgbd_calib.rig.biobjective import checks, results, solver, statistics
from rgbd_calib.rig.biobjective import problem as problems
from rgbd_calib.rig.biobjective.moments import MomentTerm
from rgbd_calib.rig.biobjective.params import RefinementParams, RefinementResult, RefinementRound
from rgbd_calib.rig.biobjective.problem import RefinementProblem
from rgbd_calib.rig.biobjective.results import Fit, pair
from rgbd_calib.rig.biobjective.solver import RefinementMinimum, Term
from rgbd_calib.rig.biobjective.terms import PointTerm
from rgbd_calib.types import Correspondences

_LEAST_SIGMAS = (1e-6, 1e-8)
"""px and m: noise-free data would drive the sigmas to zero and the weights to infinity; no sensor is below these."""


def refine(
    correspondences: Correspondences,
    intrinsics: dict[str, Intrinsics],
    T_world_color: dict[str, FloatArray],
    reference: str,
    params: RefinementParams = RefinementParams(),  # noqa: B008  (frozen)
) -> RefinementResult:
    """Poses of all cameras, refined from starting poses, with their covariance and the noise of the sensors.

    Parameters
    ----------
    correspondences : pixels and measured points; a label in both tables counts as two points, as in eq. 4.5.
    intrinsics, T_world_color : by camera; starting poses (4, 4), world from camera, metres.
    reference : the camera whose pose stays as given.

    Raises
    ------
    CalibrationError
        The data cannot fix the poses or the sigmas; the message names the camera and the cause.
    """
    checks.inputs(correspondences, intrinsics, T_world_color, reference)
    problem = problems.build(correspondences, intrinsics, T_world_color, reference, params)
    fit, sigmas, history, settled = alternate(problem, params)
    return results.assemble(fit, sigmas, history, settled, correspondences, params)


def alternate(
    problem: RefinementProblem, params: RefinementParams
) -> tuple[Fit, list[FloatArray], tuple[RefinementRound, ...], bool]:
    """Rounds of poses for given sigmas and sigmas for given poses, until the sigmas settle.

    Returns the last fit, the sigmas after it, the rounds, and whether they settled.
    """
    given = [problems.known_sigmas(params)[problem.kind(term)] for term in problem.terms]
    estimated = np.array([value is None for value in given])
    sigmas = [
        np.full(len(problem.cameras), _start_sigma(problem, i, params) if value is None else value)
        for i, value in enumerate(given)
    ]
    history: list[RefinementRound] = []
    state = problem.start
    while len(history) < params.max_rounds:
        weights = _baicp_weights(problem, params) if params.method == "baicp+" else sigmas
        for term, sigma in zip(problem.terms, weights, strict=True):
            term.set_sigmas(sigma)
        minimum = solver.minimize(
            problem.terms, state, params.method == "ba", params.cost_tolerance, params.max_iterations
        )
        state = minimum.state
        fit = _assess(problem, minimum, weights, params, estimated)
        before, sigmas = sigmas, _update(fit, sigmas, estimated, params)
        history.append(_round(problem, weights, sigmas, minimum))
        if all(np.all(np.abs(a / b - 1) <= params.sigma_tolerance) for a, b in zip(before, sigmas, strict=True)):
            return fit, sigmas, tuple(history), True
    return fit, sigmas, tuple(history), False


def _start_sigma(problem: RefinementProblem, i: int, params: RefinementParams) -> float:
    """From the residuals at the start: eq. 3.04 and 3.05, or with the redundancy that the points leave."""
    term = problem.terms[i]
    term.set_sigmas(np.ones(len(problem.cameras)))
    solver.evaluate([term], solver.RefinementState(problem.start.T, (problem.start.points[i],)))
    if params.noise_estimator == "paper":
        variance = _printed_variance(term)
    elif isinstance(term, MomentTerm):
        variance = term.sum_of_squares(0) / (3 * (term.grouping.n_observations - len(term.grouping.labels)))
    else:
        d, n = term.dimension, term.grouping.n_observations
        s2 = np.nansum(term.residuals()[0] ** 2, axis=1)
        typical = s2.mean() / d if term.loss.is_squared else np.median(s2) / chi2_isf(0.5, d)
        variance = float(typical) * d * n / max(d * n - 3 * len(term.grouping.labels), 1)
    return max(float(np.sqrt(max(variance, 0.0))), _LEAST_SIGMAS[problem.kind(term)])


def _baicp_weights(problem: RefinementProblem, params: RefinementParams) -> list[FloatArray]:
    """Sigmas that make the cost eq. 12.1: 1 / (2 sigma_3D^2) = (1 - c) / a and 1 / sigma_2D^2 = s c / b."""
    assert problem.pixels is not None and problem.xyz is not None  # baicp+ always has both
    T, X = problem.start.T, problem.start.points[0]
    R_color_world = T[:, :3, :3].transpose(0, 2, 1)
    depth = np.concatenate(
        [
            (
                R_color_world[b.cameras, 2] @ X[:, b.points]
                - np.sum(R_color_world[b.cameras, 2] * T[b.cameras, :3, 3], 1)[:, None]
            )[slice(None) if b.seen is None else b.seen].ravel()
            for b in problem.pixels.grouping.blocks
        ]
    )
    s = (depth.mean() / problem.mean_focal_px) ** 2
    a, b = n_pairs(problem.xyz), problem.pixels.grouping.n_observations
    N, c = len(problem.cameras), params.baicp_c
    return [np.full(N, np.sqrt(b / (s * c))), np.full(N, np.sqrt(a / (2 * (1 - c))))]


def n_pairs(term: Term) -> int:
    """Pairs of cameras, each once, over all points."""
    pairs = 0
    for block in term.grouping.blocks:
        n = block.points.stop - block.points.start
        k = np.full(n, len(block.cameras)) if block.seen is None else block.seen.sum(axis=0)
        pairs += int(np.sum(k * (k - 1) // 2))
    return pairs


def _printed_variance(term: Term) -> float:
    """Eq. 3.04 (a: pairs of points, l < m) or eq. 3.05 (b: pixel features in all views), in units of the sigma used."""
    if isinstance(term, MomentTerm):
        return 2 * term.sum_of_squares(1) / (2 * n_pairs(term))
    r, _ = term.residuals()
    return float(np.nansum(r**2)) / term.grouping.n_observations


def _assess(
    problem: RefinementProblem,
    minimum: RefinementMinimum,
    weights: list[FloatArray],
    params: RefinementParams,
    estimated: np.ndarray,
) -> Fit:
    shares = [statistics.share(term) for term in problem.terms]
    gauge = solver.gauge_direction(minimum.state.T) if params.method == "ba" else None
    checks.rank(problem.cameras, np.sum([s.N for s in shares], axis=0), gauge)
    C = statistics.pose_inverse(shares, gauge)
    for term, own, free in zip(problem.terms, shares, estimated, strict=True):
        if free and params.noise_estimator == "redundancy":
            checks.redundancy(("2d", "3d")[problem.kind(term)], own.n - float(np.vdot(C, own.N)), int(own.n))
    return Fit(problem, minimum, weights, shares, C, statistics.mean_squares(shares, C))


def _update(fit: Fit, sigmas: list[FloatArray], estimated: np.ndarray, params: RefinementParams) -> list[FloatArray]:
    """Sigmas for the poses of a fit."""
    terms = fit.problem.terms
    if params.noise_estimator == "paper":
        factors = [np.sqrt(_printed_variance(term)) for term in terms]
    elif params.per_camera_sigmas:
        factors = [np.sqrt(np.divide(*term.squares_by_camera(fit.C))) for term in terms if isinstance(term, PointTerm)]
    else:
        factors = list(np.sqrt(statistics.variances(fit.shares, fit.M, estimated)))
    return [
        np.maximum(weight * factor, _LEAST_SIGMAS[fit.problem.kind(term)]) if free else sigma
        for term, weight, factor, sigma, free in zip(terms, fit.weights, factors, sigmas, estimated, strict=True)
    ]


def _round(
    problem: RefinementProblem, weights: list[FloatArray], sigmas: list[FloatArray], minimum: RefinementMinimum
) -> RefinementRound:
    px, m = pair(problem, sigmas)
    used_px, used_m = pair(problem, weights)
    return RefinementRound(2 * used_m**2 / used_px**2, px, m, minimum.cost, minimum.iterations)

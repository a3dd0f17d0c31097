"""From the last fit to the result: back to the caller's order, with what everything is worth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.biobjective import checks, problem, start, statistics
from rgbd_calib.rig.biobjective.groups import Grouping
from rgbd_calib.rig.biobjective.moments import MomentTerm
from rgbd_calib.rig.biobjective.params import RefinementParams, RefinementResult, RefinementRound
from rgbd_calib.rig.biobjective.problem import RefinementProblem
from rgbd_calib.rig.biobjective.solver import RefinementMinimum
from rgbd_calib.rig.biobjective.statistics import Share
from rgbd_calib.rig.biobjective.terms import MeasuredPointTerm
from rgbd_calib.types import Correspondences, IntArray


@dataclass(frozen=True)
class Fit:
    """A round: the minimum, the sigmas (term by term, (N,)) that its weights used, and its statistics."""

    problem: RefinementProblem
    minimum: RefinementMinimum
    weights: list[FloatArray]
    shares: list[Share]
    C: FloatArray
    M: FloatArray


@dataclass(frozen=True)
class _ResidualTable:
    residuals: FloatArray
    weights: FloatArray
    points_m: FloatArray


def pair(problem: RefinementProblem, sigmas: list[FloatArray]) -> tuple[float, float]:
    """Root mean square over the cameras of sigma_2D and sigma_3D; NaN for a term that takes no part."""
    out = [float("nan"), float("nan")]
    for term, sigma in zip(problem.terms, sigmas, strict=True):
        out[problem.kind(term)] = float(np.sqrt(np.mean(sigma**2)))
    return out[0], out[1]


def assemble(
    fit: Fit,
    sigmas: list[FloatArray],
    history: tuple[RefinementRound, ...],
    settled: bool,
    data: Correspondences,
    params: RefinementParams,
) -> RefinementResult:
    """The result; raises CalibrationError where the points turn out to lie on a line within their noise."""
    own, cameras = fit.problem, data.cameras
    px, m = pair(own, sigmas)
    sets = problem.point_sets(own, fit.minimum.state, data)
    noise = [m * term.typical_scale if isinstance(term, MeasuredPointTerm) else m for term in own.terms]
    noise = [n if own.kind(term) else 0.0 for n, term in zip(noise, own.terms, strict=True)]
    checks.spread(own.cameras, [(g, X, n) for (g, X), n in zip(sets, noise, strict=True)])

    order = [own.cameras.index(c) for c in cameras]
    at = (6 * np.array(order)[:, None] + np.arange(6)).ravel()
    joint = _joint_covariance(fit, sigmas, params)[at[:, None], at]
    T = fit.minimum.state.T
    variances = _variances(fit, sigmas)
    expected = fit.M @ variances
    by_camera = [{c: float("nan") for c in cameras} for _ in range(2)]
    redundancy, factor = [float("nan")] * 2, [float("nan")] * 2
    for i, (term, share) in enumerate(zip(own.terms, fit.shares, strict=True)):
        kind = own.kind(term)
        by_camera[kind] = {c: float(sigmas[i][o]) for c, o in zip(cameras, order, strict=True)}
        redundancy[kind] = share.n - float(np.vdot(fit.C, share.N))
        factor[kind] = float(share.squares / expected[i])
    pixels, xyz = _pixel_table(fit, data), _xyz_table(fit, data)
    return RefinementResult(
        cameras=cameras,
        reference=own.cameras[0],
        T_world_color={c: T[o] for c, o in zip(cameras, order, strict=True)},
        covariance={c: joint[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i, c in enumerate(cameras)},
        joint_covariance=joint,
        points_m=pixels.points_m,
        points_3d_m=xyz.points_m,
        sigma_2d_px=px,
        sigma_3d_m=m,
        sigma_covariance=_sigma_covariance(fit, sigmas, params),
        sigmas_2d_px=by_camera[0],
        sigmas_3d_m=by_camera[1],
        w=2 * m**2 / px**2,
        redundancy_2d=redundancy[0],
        redundancy_3d=redundancy[1],
        variance_factor_2d=factor[0],
        variance_factor_3d=factor[1],
        history=history,
        cost=fit.minimum.cost,
        iterations=sum(r.iterations for r in history),
        status=fit.minimum.status if settled else "round_limit",
        message=fit.minimum.message if settled else f"the sigmas still changed after {len(history)} rounds",
        residuals_2d_px=pixels.residuals,
        residuals_3d_m=xyz.residuals,
        weights_2d=pixels.weights,
        weights_3d=xyz.weights,
        dropped=own.dropped,
    )


def _variances(fit: Fit, sigmas: list[FloatArray]) -> FloatArray:
    """Relative variances (terms,): those of the sigmas over those of the weights."""
    return np.array([np.mean(s**2) / np.mean(w**2) for s, w in zip(sigmas, fit.weights, strict=True)])


def _weights_estimated(fit: Fit, params: RefinementParams) -> IntArray:
    """Terms whose sigma was estimated, as numbers."""
    known = problem.known_sigmas(params)
    return np.flatnonzero([known[fit.problem.kind(term)] is None for term in fit.problem.terms])


def _relative_covariance(fit: Fit, params: RefinementParams) -> FloatArray:
    """W (terms, terms), of the relative variances; 0 for a sigma that was given."""
    W = np.zeros_like(fit.M)
    i = _weights_estimated(fit, params)
    if len(i):
        W[np.ix_(i, i)] = 2 * np.linalg.inv(fit.M[np.ix_(i, i)])
    return (W + W.T) / 2


def _joint_covariance(fit: Fit, sigmas: list[FloatArray], params: RefinementParams) -> FloatArray:
    """(6 N, 6 N) in the solver's order, zeros for the reference."""
    cov = statistics.covariance(fit.shares, fit.C, _variances(fit, sigmas))
    likelihood = params.method == "biobjective" and params.pairs == "latent" and params.noise_estimator == "redundancy"
    if likelihood:
        cov += statistics.small_sample_growth(fit.shares, fit.C, _relative_covariance(fit, params))
    out = np.zeros((len(cov) + 6, len(cov) + 6))
    out[6:, 6:] = cov
    return out


def _sigma_covariance(fit: Fit, sigmas: list[FloatArray], params: RefinementParams) -> FloatArray:
    """(2, 2) of sigma_2D and sigma_3D: d sigma = sigma / 2 times the relative variance's."""
    out = np.full((2, 2), np.nan)
    W, values = _relative_covariance(fit, params), pair(fit.problem, sigmas)
    kinds = [fit.problem.kind(term) for term in fit.problem.terms]
    for i, a in enumerate(kinds):
        for j, b in enumerate(kinds):
            out[a, b] = W[i, j] * values[a] * values[b] / 4
    return out


def _pixel_table(fit: Fit, data: Correspondences) -> _ResidualTable:
    n = len(data.pixels_px)
    table = _ResidualTable(np.full((n, 2), np.nan), np.full(n, np.nan), np.full((len(data.labels), 3), np.nan))
    term = fit.problem.pixels
    if term is not None:
        rows = fit.problem.pixel_rows
        r, weights = term.residuals()
        camera = np.array([fit.problem.cameras.index(c) for c in data.cameras])[data.pixel_camera[rows]]
        table.residuals[rows], table.weights[rows] = r * fit.weights[0][camera, None], weights
        table.points_m[term.grouping.labels] = fit.minimum.state.points[0].T
    return table


def _xyz_table(fit: Fit, data: Correspondences) -> _ResidualTable:
    n = len(data.xyz_m)
    table = _ResidualTable(np.full((n, 3), np.nan), np.full(n, np.nan), np.full((len(data.labels), 3), np.nan))
    term = fit.problem.xyz
    if term is None:
        return table
    T = fit.minimum.state.T
    if isinstance(term, MomentTerm):
        X = start.mean_points(term.grouping, data.xyz_m, T)
    else:
        X = fit.minimum.state.points[-1]
        table.weights[:] = term.residuals()[1]
    table.points_m[term.grouping.labels] = X.T
    _fill_xyz(table, term.grouping, data.xyz_m, X, T, isinstance(term, MomentTerm))
    return table


def _fill_xyz(
    table: _ResidualTable, grouping: Grouping, xyz_m: FloatArray, X: FloatArray, T: FloatArray, ones: bool
) -> None:
    for block in grouping.blocks:
        for i, camera in enumerate(block.cameras):
            seen = slice(None) if block.seen is None else block.seen[i]
            rows = block.rows[i][seen]
            table.residuals[rows] = xyz_m[rows] - (X[:, block.points].T[seen] - T[camera, :3, 3]) @ T[camera, :3, :3]
            if ones:
                table.weights[rows] = 1.0

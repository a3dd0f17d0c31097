"""The rounds of the bundle: solve, weigh, drop what is grossly wrong, until nothing changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.bundle import gross, model, observability, solve, variance
from rgbd_calib.rig.bundle.common_errors import common_errors
from rgbd_calib.rig.bundle.model import Observations, State
from rgbd_calib.rig.bundle.params import BundleParams, CameraPrior, Round
from rgbd_calib.rig.bundle.result import BundleResult
from rgbd_calib.rig.bundle.solve import Prior, Weights
from rgbd_calib.rig.bundle.start import bias_terms, depth_ranges, depth_units, prior_of, start
from rgbd_calib.types import Board, PlacedView


def bundle(
    views: Sequence[PlacedView],
    board: Board,
    priors: Mapping[str, CameraPrior],
    T_world_color: Mapping[str, FloatArray],
    reference: str,
    params: BundleParams | None = None,
) -> BundleResult:
    """Solve for everything at once.

    Parameters
    ----------
    views : all views; several cameras' views of one frame are of one board pose. Views of an intrinsic recording are
        frames of their own.
    priors, T_world_color : by camera; the poses are a start.

    Raises
    ------
    CalibrationError
        The equations are singular, or too few views are left.
    """
    params = params or BundleParams()
    cameras = tuple(priors)
    depth_range = depth_ranges(views, priors)
    n_bias = bias_terms(priors)
    all_obs, frames = model.observe(views, board, depth_units(priors), depth_range, n_bias)
    state = start(views, frames, all_obs, priors, T_world_color, n_bias)
    prior = prior_of(state, all_obs, priors, reference, params)
    weights = variance.initial(all_obs, len(cameras), params.sigma_2d_px, params.k_depth_per_m)
    obs, dropped, dropped_corners = all_obs, dict[tuple[str, str], str](), 0
    history: list[Round] = []
    iterations, settled, taken_back = 0, False, False
    for _ in range(params.max_rounds):
        solution = solve.minimize(state, obs, board, weights, prior, params.max_iterations, params.round_tolerance)
        state, iterations = solution.state, iterations + solution.iterations
        new = variance.update(state, obs, board, weights, prior, params.huber_sigmas)
        moved = variance.change(weights, new)
        weights = new
        history.append(_round(solution.cost, weights, len(dropped)))
        if moved < 0.1:  # the scales are known well enough to call something an outlier
            found = gross.find(state, obs, board, weights, params.max_view_ratio, params.max_depth_sigmas)
            reasons = {v: why for v, why in found.pixel_views.items()}
            reasons |= {v: f"depth only: {why}" for v, why in found.depth_views.items()}
            dropped |= {(views[v].view.camera, views[v].view.frame): why for v, why in reasons.items()}
            dropped_corners += found.depth_corners
            if reasons or found.depth_corners:
                obs = obs.keep(found.has_pixel, found.has_depth)
                _check_left(obs, cameras, reference, dropped)
                continue
        if moved < params.weight_tolerance:
            if dropped and not taken_back:
                taken_back = True
                limits = params.max_view_ratio, params.max_depth_sigmas
                obs, back = gross.take_back(state, obs, all_obs, board, weights, *limits)
                dropped = {
                    key: why
                    for key, why in dropped.items()
                    if key not in {(views[v].view.camera, views[v].view.frame) for v in back}
                }
                continue
            settled = True
            break
    end = _conclude(state, obs, board, weights, prior, priors, params)
    return BundleResult(
        cameras=cameras,
        priors=dict(priors),
        prior=prior,
        bias_range_m=depth_range,
        has_bias=tuple(bool(np.any(all_obs.has_depth[all_obs.camera == i])) for i in range(len(cameras))),
        views=tuple(views),
        frames=frames,
        obs=obs,
        weights=weights,
        dropped=dropped,
        dropped_depth_corners=dropped_corners,
        history=tuple(history),
        iterations=iterations + end.pop("iterations"),
        converged=settled,
        message=_message(settled, params),
        **end,
    )


def free_structure(result: BundleResult, board: Board, params: BundleParams | None = None) -> BundleResult:
    """The bundle again, with the corners of shared frames as free points instead of a rigid board (the paper, eq. 4.5).

    For boards whose print or flatness is not to be trusted. `result`, from :func:`bundle`, is the start, and has found the
    gross errors. The scale then comes from the depth, and from the views of single cameras, which keep the board.

    Raises
    ------
    CalibrationError
        No two cameras have depth on common corners, or the equations are singular.
    """
    params = params or BundleParams()
    state, obs = model.free(result.state, result.obs, board)
    if not np.any(obs.has_depth[obs.shared]):
        raise CalibrationError(
            "structure free: no depth on the corners that cameras share, which alone gives free points their scale. "
            "Record depth, or take structure board"
        )
    weights, history, iterations, settled = result.weights, list(result.history), result.iterations, False
    for _ in range(params.max_rounds):
        solution = solve.minimize(
            state, obs, board, weights, result.prior, params.max_iterations, params.round_tolerance
        )
        state, iterations = solution.state, iterations + solution.iterations
        new = variance.update(state, obs, board, weights, result.prior, params.huber_sigmas)
        settled = variance.change(weights, new) < params.weight_tolerance
        weights = new
        history.append(_round(solution.cost, weights, len(result.dropped)))
        if settled:
            break
    end = _conclude(state, obs, board, weights, result.prior, result.priors, params)
    return replace(
        result,
        obs=obs,
        weights=weights,
        history=tuple(history),
        iterations=iterations + end.pop("iterations"),
        converged=settled,
        message=_message(settled, params) + "; corners are free points",
        **end,
    )


def _conclude(
    state: State,
    obs: Observations,
    board: Board,
    weights: Weights,
    prior: Prior,
    priors: Mapping[str, CameraPrior],
    params: BundleParams,
) -> dict[str, Any]:
    """The last minimisation and what it says: fields of the result.

    What the recording does not determine is held at its prior; the covariance still counts its uncertainty.
    """
    cov = solve.covariance(solve.build(state, obs, board, weights, prior), prior.free)
    seen = observability.examine(tuple(priors), state, cov, prior)
    held = replace(prior, free=prior.free & ~seen.undetermined)
    restart = solve.with_values(state, seen.undetermined, prior)
    final = solve.minimize(restart, obs, board, weights, held, params.max_iterations, params.tolerance)
    system = solve.build(final.state, obs, board, weights, prior)
    cov = solve.covariance(system, prior.free)
    honest = solve.honest_covariance(cov, final.state, obs, board, weights, prior)
    sizes_px = np.array([[own.intrinsics.width, own.intrinsics.height] for own in priors.values()], float)
    common = common_errors(final.state, obs, board, weights, system, cov, sizes_px)
    pixel, depth = model.residuals(final.state, obs, board)
    return {
        "state": final.state,
        "covariance": honest + common.covariance,
        "common": common,
        "cost": final.cost,
        "iterations": final.iterations,
        "observability": seen,
        "residual_pixel": pixel,
        "residual_depth": depth,
    }


def _round(cost: float, weights: Weights, dropped_views: int) -> Round:
    return Round(
        cost,
        tuple(weights.sigma_2d_px.tolist()),
        tuple(weights.k_depth.tolist()),
        weights.cell_exponent,
        float(np.sqrt(np.mean(weights.ratio_pixel**2))),
        float(np.sqrt(np.mean(weights.ratio_depth**2))),
        dropped_views,
    )


def _message(settled: bool, params: BundleParams) -> str:
    return "weights and unknowns settled" if settled else f"the weights still moved after {params.max_rounds} rounds"


def _check_left(
    obs: Observations, cameras: Sequence[str], reference: str, dropped: Mapping[tuple[str, str], str]
) -> None:
    """Every camera must still be joined to the reference by frames that are left."""
    used = obs.has_pixel.any(axis=1) & obs.shared
    joined, grown = {cameras.index(reference)}, True
    while grown:
        frames = {int(f) for f, c in zip(obs.frame[used], obs.camera[used], strict=True) if int(c) in joined}
        more = {int(c) for f, c in zip(obs.frame[used], obs.camera[used], strict=True) if int(f) in frames}
        grown, joined = not more <= joined, joined | more
    lost = [name for i, name in enumerate(cameras) if i not in joined]
    if lost:
        why = "; ".join(
            f"{camera} frame {frame}: {text}" for (camera, frame), text in dropped.items() if camera in lost
        )
        raise CalibrationError(
            f"{', '.join(lost)}: no view is left that agrees with the other cameras ({why}); five common views are needed. "
            "The camera moved while the recording was made, its frames are of other instants or mirrored, or the board moved "
            "between exposures: fix the camera, hold the board still while all expose, and film again"
        )

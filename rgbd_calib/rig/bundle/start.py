"""Where the bundle starts, and the Gaussian knowledge that it starts with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rgbd_calib.geometry.camera import N_INTRINSICS
from rgbd_calib.geometry.inverse import symmetric_inverse
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.bundle import solve
from rgbd_calib.rig.bundle.model import N_BOW, Observations, State
from rgbd_calib.rig.bundle.params import N_WEAK_BIAS, BundleParams, CameraPrior
from rgbd_calib.rig.bundle.solve import Prior
from rgbd_calib.types import DepthBias, PlacedView


def depth_ranges(views: Sequence[PlacedView], priors: Mapping[str, CameraPrior]) -> FloatArray:
    """(C, 2): where each depth bias is a polynomial; the prior's range, else the range of the data."""
    ranges = []
    for name, prior in priors.items():
        depths = [placed.view.depth_m for placed in views if placed.view.camera == name]
        z = np.concatenate(depths) if depths else np.empty(0)
        z = z[np.isfinite(z)]
        if prior.bias is not None:
            ranges.append((prior.bias.min_m, prior.bias.max_m))
        else:
            ranges.append((float(z.min()), float(z.max())) if len(z) else (0.0, 1.0))
    return np.array(ranges)


def depth_units(priors: Mapping[str, CameraPrior]) -> dict[str, float]:
    """Unit of each camera's depth, metres."""
    return {name: prior.depth_unit_m for name, prior in priors.items()}


def bias_terms(priors: Mapping[str, CameraPrior]) -> int:
    """Coefficients of the depth bias that every camera's parameters have room for."""
    return max([N_WEAK_BIAS, *(len(p.bias.coefficients) for p in priors.values() if p.bias is not None)])


def start(
    views: Sequence[PlacedView],
    frames: tuple[str, ...],
    obs: Observations,
    priors: Mapping[str, CameraPrior],
    T_world_color: Mapping[str, FloatArray],
    n_bias: int,
) -> State:
    bias = np.zeros((len(priors), n_bias))
    for row, prior in zip(bias, priors.values(), strict=True):
        if prior.bias is not None:
            row[: len(prior.bias.coefficients)] = prior.bias.coefficients
    boards = np.tile(np.eye(4), (len(frames), 1, 1))
    for placed, f, shared in zip(views, obs.frame, obs.shared, strict=True):
        boards[f] = T_world_color[placed.view.camera] @ placed.T_color_board if shared else placed.T_color_board
    return State(
        np.stack([T_world_color[name] for name in priors]),
        np.stack([prior.intrinsics.vector for prior in priors.values()]),
        bias,
        boards,
        np.zeros(N_BOW),
        np.zeros(len(frames), bool),
        np.zeros((len(frames), 0, 3)),
    )


def prior_of(
    state: State, obs: Observations, priors: Mapping[str, CameraPrior], reference: str, params: BundleParams
) -> Prior:
    information = np.zeros((state.n_global, state.n_global))
    free, assumed = np.ones(state.n_global, bool), np.zeros(state.n_global, bool)
    n = state.n_camera
    for i, (name, prior) in enumerate(priors.items()):
        at = i * n
        free[at : at + 6] = name != reference
        sd = _intrinsics_sd(prior, params)
        lens = np.arange(at + 6, at + 6 + N_INTRINSICS)
        information[lens, lens] = 1 / np.maximum(sd, 1e-9) ** 2
        free[lens] = params.free_intrinsics and bool(np.any(obs.has_pixel[obs.camera == i]))
        assumed[lens] = prior.intrinsics_sd is None or prior.from_views
        free[lens[8]] &= params.free_k3 or prior.intrinsics.distortion[4] != 0
        coefficients = np.arange(at + 6 + N_INTRINSICS, at + n)
        n_own = len(prior.bias.coefficients) if prior.bias is not None else N_WEAK_BIAS
        free[coefficients] = (np.arange(len(coefficients)) < n_own) & np.any(obs.has_depth[obs.camera == i])
        own = coefficients[:n_own]
        assumed[own] = prior.bias is None or prior.bias.covariance is None
        information[np.ix_(own, own)] = _bias_information(prior.bias, n_own, params)
        if prior.held != "nothing":
            free[at if prior.held == "all" else lens[0] : at + n] = False
    bow = np.arange(state.n_global - N_BOW, state.n_global)
    information[bow, bow] = 1 / params.bow_sd_m**2
    free[bow] = params.free_bow
    return Prior(solve.values(state), information, free, assumed)


def _intrinsics_sd(prior: CameraPrior, params: BundleParams) -> FloatArray:
    """(9,) standard deviations of the intrinsics before the bundle."""
    if prior.intrinsics_sd is not None and not prior.from_views:
        return prior.intrinsics_sd
    focal, centre, distortion = (
        (params.weak_focal, params.weak_centre, params.weak_distortion)
        if prior.from_views
        else (params.given_focal, params.given_centre, params.given_distortion)
    )
    own = prior.intrinsics
    tangential = distortion / 10
    return np.array(
        [
            focal * own.fx,
            focal * own.fy,
            centre * own.width,
            centre * own.width,
            distortion,
            distortion,
            tangential,
            tangential,
            distortion,
        ]
    )


def _bias_information(bias: DepthBias | None, n: int, params: BundleParams) -> FloatArray:
    if bias is not None and bias.covariance is not None:
        return symmetric_inverse(bias.covariance)
    sd = [params.bias_offset_sd_m, params.bias_scale_sd] + [params.bias_curvature_sd_per_m] * max(n - 2, 0)
    return np.diag(1 / np.square(sd[:n]))

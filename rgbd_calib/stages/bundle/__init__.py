"""The joint bundle of all cameras, boards, intrinsics and depth biases, on pixels and depth together.

The pixels alone leave the focal lengths a little free, and with them the distances: that error dominates a real rig.
Measured depth pins them. :mod:`.model` has the unknowns and residuals, :mod:`.solve` the minimiser and the covariance,
:mod:`.variance` the weights, :mod:`.gross` what is dropped, :mod:`.observability` what the recording cannot tell.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry.camera import N_INTRINSICS, Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.stages.bundle import gross, model, observability, solve, variance
from rgbd_calib.stages.bundle.model import N_BOW, Observations, State
from rgbd_calib.stages.bundle.solve import Prior, Weights
from rgbd_calib.types import Board, DepthBias, PlacedView


N_WEAK_BIAS = 3
"""Coefficients of a depth bias that has no recording: offset, scale, curvature."""


@dataclass(frozen=True)
class BundleParams:
    sigma_2d_px: float = 0.2
    """First guess; estimated from the residuals."""
    k_depth_per_m: float = 0.002
    """First guess of k in sigma_z = k z^2, for the mean over a corner's cell; estimated."""
    free_intrinsics: bool = True
    free_k3: bool = False
    free_bow: bool = True
    bow_sd_m: float = 0.001
    """Prior of the board's bow: boards are flat to about a millimetre."""
    weak_focal: float = 0.1
    """Prior of focal lengths that the recording itself determines, as a share of them: only against a singular matrix."""
    weak_centre: float = 0.1
    """The same for the principal point, as a share of the image's width."""
    weak_distortion: float = 0.5
    given_focal: float = 0.005
    """Prior of focal lengths that were given in a file without standard deviations."""
    given_centre: float = 0.005
    given_distortion: float = 0.02
    bias_offset_sd_m: float = 0.010
    """Prior of the depth's offset without a bias recording."""
    bias_scale_sd: float = 0.010
    """Prior of the depth's scale without a bias recording: consumer sensors are good to 1 %."""
    bias_curvature_sd_per_m: float = 0.005
    """Prior of the depth bias's quadratic term without a bias recording."""
    huber_sigmas: float = 3.0
    max_view_ratio: float = 4.0
    max_depth_sigmas: float = 5.0
    max_rounds: int = 20
    max_iterations: int = 30
    tolerance: float = 1e-9
    """Relative change of the cost that ends a minimisation."""
    weight_tolerance: float = 0.005
    """Relative change of any sigma that ends the rounds."""


@dataclass(frozen=True)
class CameraPrior:
    """What is known of a camera before the bundle."""

    intrinsics: Intrinsics
    intrinsics_sd: FloatArray | None
    """(9,) standard deviations of a given calibration; None: none are known."""
    from_views: bool
    """True where the intrinsics are only a start: the views that they rest on are in the bundle."""
    bias: DepthBias | None
    held: Literal["nothing", "lens", "all"] = "nothing"
    """What is known exactly: intrinsics and depth bias, or the pose too (its start is the pose)."""


@dataclass(frozen=True)
class Round:
    """Weights after one round."""

    cost: float
    sigma_2d_px: tuple[float, ...]
    k_depth: tuple[float, ...]
    ratio_pixel: float
    ratio_depth: float
    dropped_views: int


@dataclass(frozen=True)
class BundleResult:
    """The calibrated rig; cameras in the order of `cameras`."""

    cameras: tuple[str, ...]
    priors: Mapping[str, CameraPrior]
    state: State
    weights: Weights
    covariance: FloatArray
    """(P, P) of all cameras' parameters and the bow; see :meth:`parameters`."""
    prior: Prior
    bias_range_m: FloatArray
    """(C, 2)."""
    has_bias: tuple[bool, ...]
    """Cameras with depth on the board."""
    views: tuple[PlacedView, ...]
    """All views, in the order of the observations."""
    frames: tuple[str, ...]
    obs: Observations
    """What was used at the end."""
    dropped: dict[tuple[str, str], str]
    """Why, by (camera, frame): the view, or its depth, was left out."""
    dropped_depth_corners: int
    history: tuple[Round, ...]
    cost: float
    iterations: int
    converged: bool
    message: str
    observability: observability.Observability
    residual_pixel: FloatArray
    """(V, N, 2), predicted - measured, px; zero where nothing was used."""
    residual_depth: FloatArray
    """(V, N), the same for depth, over z^2."""

    def parameters(self, camera: str) -> slice:
        """Where a camera's parameters stand in the covariance: pose 6, intrinsics 9, bias B."""
        i, n = self.cameras.index(camera), self.state.n_camera
        return slice(i * n, (i + 1) * n)

    def depth_bias(self, camera: str) -> DepthBias | None:
        """The depth bias of a camera with depth on the board; its RMS is what depth is off by after the correction."""
        i, prior = self.cameras.index(camera), self.priors[camera].bias
        if not self.has_bias[i]:
            return prior
        n = len(prior.coefficients) if prior is not None else N_WEAK_BIAS
        at = self.parameters(camera).start + 6 + N_INTRINSICS
        covariance = self.covariance[at : at + n, at : at + n]
        low, high = (float(z) for z in self.bias_range_m[i])
        coefficients = tuple(float(c) for c in self.state.bias[i, :n])
        return DepthBias(coefficients, low, high, self.depth_rms_m(camera), covariance)

    def depth_rms_m(self, camera: str) -> float:
        """RMS of the depth residuals that were used, metres."""
        mine = self.obs.has_depth & (self.obs.camera == self.cameras.index(camera))[:, None]
        r = self.residual_depth * self.obs.depth_m**2
        return float(np.sqrt(np.mean(r[mine] ** 2))) if mine.any() else 0.0


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
    depth_range = _depth_ranges(views, priors)
    n_bias = max([N_WEAK_BIAS, *(len(p.bias.coefficients) for p in priors.values() if p.bias is not None)])
    all_obs, frames = model.observe(views, board, cameras, depth_range, n_bias)
    state = _start(views, frames, all_obs, priors, T_world_color, n_bias)
    prior = _prior(state, all_obs, priors, reference, params)
    weights = variance.initial(all_obs, len(cameras), params.sigma_2d_px, params.k_depth_per_m)
    obs, dropped, dropped_corners = all_obs, dict[tuple[str, str], str](), 0
    history: list[Round] = []
    iterations, settled = 0, False
    for _ in range(params.max_rounds):
        solution = solve.minimize(state, obs, board, weights, prior, params.max_iterations, params.tolerance)
        state, iterations = solution.state, iterations + solution.iterations
        new = variance.update(state, obs, board, weights, prior, params.huber_sigmas)
        moved = variance.change(weights, new)
        weights = new
        history.append(
            Round(
                solution.cost,
                tuple(weights.sigma_2d_px.tolist()),
                tuple(weights.k_depth.tolist()),
                weights.ratio_pixel,
                weights.ratio_depth,
                len(dropped),
            )
        )
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
            settled = True
            break
    # what the recording does not determine is held at its prior; the covariance still counts its uncertainty
    cov = solve.covariance(solve.build(state, obs, board, weights, prior), prior.free)
    seen = observability.examine(cameras, state, cov, prior)
    held = replace(prior, free=prior.free & ~seen.undetermined)
    start = solve.with_values(state, seen.undetermined, prior)
    final = solve.minimize(start, obs, board, weights, held, params.max_iterations, params.tolerance)
    system = solve.build(final.state, obs, board, weights, prior)
    cov = solve.covariance(system, prior.free)
    honest = solve.honest_covariance(system, cov, obs, weights, prior)
    message = "weights and unknowns settled" if settled else f"the weights still moved after {params.max_rounds} rounds"
    return BundleResult(
        cameras,
        dict(priors),
        final.state,
        weights,
        honest,
        prior,
        depth_range,
        tuple(bool(np.any(all_obs.has_depth[all_obs.camera == i])) for i in range(len(cameras))),
        tuple(views),
        frames,
        obs,
        dropped,
        dropped_corners,
        tuple(history),
        final.cost,
        iterations + final.iterations,
        settled,
        message,
        seen,
        *model.residuals(final.state, obs, board),
    )


def _depth_ranges(views: Sequence[PlacedView], priors: Mapping[str, CameraPrior]) -> FloatArray:
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


def _start(
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
    )


def _prior(
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
        return np.asarray(np.linalg.pinv(bias.covariance, hermitian=True), float)
    sd = [params.bias_offset_sd_m, params.bias_scale_sd] + [params.bias_curvature_sd_per_m] * max(n - 2, 0)
    return np.diag(1 / np.square(sd[:n]))


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
            "Hold the board still while all cameras expose, and film again"
        )


def pose_covariance(result: BundleResult, camera: str) -> FloatArray:
    """(6, 6) of the left perturbation (rad, m) of T_world_color in the world frame."""
    at = result.parameters(camera).start
    return result.covariance[at : at + 6, at : at + 6]


def board_poses(result: BundleResult) -> dict[str, FloatArray]:
    """T_world_board (4, 4) of the frames that several cameras see."""
    shared = {int(f) for f, s in zip(result.obs.frame, result.obs.shared, strict=True) if s}
    return {frame: result.state.T_parent_board[f] for f, frame in enumerate(result.frames) if f in shared}


def camera_statistics(result: BundleResult, camera: str) -> dict[str, Any]:
    """Plain numbers of one camera, for the rig file."""
    i = result.cameras.index(camera)
    mine = result.obs.camera == i
    pixels, depths = result.obs.has_pixel & mine[:, None], result.obs.has_depth & mine[:, None]
    sd = np.sqrt(np.diag(result.covariance))[result.parameters(camera)]
    out: dict[str, Any] = {
        "intrinsics_sd": sd[6 : 6 + N_INTRINSICS],
        "sigma_2d_px": result.weights.sigma_2d_px[i],
        "rms_px": float(np.sqrt(np.mean(result.residual_pixel[pixels] ** 2))) if pixels.any() else None,
        "views": int(pixels.any(axis=1).sum()),
        "corners": int(pixels.sum()),
        "corners_with_depth": int(depths.sum()),
    }
    if depths.any():
        k = float(result.weights.k_depth[i])
        mean_z2 = float(np.mean(result.obs.depth_m[depths] ** 2))
        out |= {
            "sigma_3d_m": k * mean_z2,
            "sigma_3d_model": "along the optical axis, k z^2, mean over a corner's cell; sigma_3d_m at the mean z^2",
            "depth_k_per_m": k,
            "depth_rms_m": result.depth_rms_m(camera),
        }
    return out


__all__ = [
    "BundleParams",
    "BundleResult",
    "CameraPrior",
    "Round",
    "board_poses",
    "bundle",
    "camera_statistics",
    "pose_covariance",
]

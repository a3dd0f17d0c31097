"""What the bundle returns, and what is read from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rgbd_calib.geometry.camera import N_INTRINSICS
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.bundle.common_errors import CommonErrors
from rgbd_calib.rig.bundle.model import Observations, State
from rgbd_calib.rig.bundle.observability import Observability
from rgbd_calib.rig.bundle.params import N_WEAK_BIAS, CameraPrior, Round
from rgbd_calib.rig.bundle.solve import Prior, Weights
from rgbd_calib.types import DepthBias, PlacedView


@dataclass(frozen=True)
class BundleResult:
    """The calibrated rig; cameras in the order of `cameras`."""

    cameras: tuple[str, ...]
    priors: Mapping[str, CameraPrior]
    state: State
    weights: Weights
    covariance: FloatArray
    """(P, P) of all cameras' parameters and the bow; see :meth:`parameters`."""
    common: CommonErrors
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
    observability: Observability
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

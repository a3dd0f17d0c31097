"""What the bundle returns: the problem at its minimum, the covariance, and what was dropped on the way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.depth_error import CellPattern, PolynomialField
from rgbd_calib.geometry.linear import Covariance, IntArray
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.quality import CameraStatistics
from rgbd_calib.rig.blocks import BoardShapeBlock, DepthBiasBlock, depth_field, registration
from rgbd_calib.rig.common_errors import CommonErrors
from rgbd_calib.rig.observability import Observability
from rgbd_calib.rig.problem import Problem, State
from rgbd_calib.rig.setup import CameraPrior
from rgbd_calib.types import BoardShape, DepthBias, DepthCamera, DepthField, PlacedView


@dataclass(frozen=True)
class Round:
    """Weights after one round."""

    cost: float
    sigma_2d_px: tuple[float, ...]
    k_depth: tuple[float, ...]
    cell_exponent: float
    ratio_pixel: float
    """RMS over the kinds of pose part."""
    ratio_depth: float
    dropped_views: int


@dataclass(frozen=True)
class Course:
    """What went in, and how the solution was reached."""

    views: tuple[PlacedView, ...]
    """All views, in the order of the observations."""
    frames: tuple[str, ...]
    """Of the boards' poses."""
    dropped: Mapping[tuple[str, str], str]
    """Why, by (camera, frame): the view, or its depth, was left out."""
    dropped_depth_corners: int
    history: tuple[Round, ...]
    iterations: int
    converged: bool
    message: str


@dataclass(frozen=True)
class Solution:
    """The calibrated rig; cameras in the order of `cameras`."""

    problem: Problem
    """With the weights, masks and priors at the end."""
    state: State
    cost: float
    plain: Covariance
    """As if pixels erred each by itself, and cells shared nothing."""
    covariance: FloatArray
    """(P, P) of the globals, what views and cells share counted."""
    common: CommonErrors
    observability: Observability
    course: Course

    @property
    def cameras(self) -> tuple[str, ...]:
        return self.problem.setup.cameras

    @property
    def has_depth(self) -> tuple[bool, ...]:
        """Cameras with depth on the board."""
        obs = self.problem.setup.obs
        return tuple(bool(np.any(obs.has_depth[obs.camera == i])) for i in range(len(self.cameras)))

    def prior_of(self, camera: str) -> CameraPrior:
        return self.problem.setup.priors[self.cameras.index(camera)]

    def index(self, block: str, camera: str) -> IntArray:
        """Where a camera's parameters of a block stand in the covariance."""
        return self.problem.index(block, self.cameras.index(camera))

    @cached_property
    def residuals(self) -> tuple[FloatArray, FloatArray]:
        """Predicted less measured, pixels (V, N, 2) and depth (V, N), metres; zero where nothing was used."""
        return self.problem.residuals(self.state)

    def T_world_color(self, camera: str) -> FloatArray:
        """(4, 4)."""
        return np.asarray(self.state.T_world_color[self.cameras.index(camera)])

    def pose_covariance(self, camera: str) -> FloatArray:
        """(6, 6) of the left perturbation (rad, m) of T_world_color in the world frame."""
        at = self.index("pose", camera)
        return self.covariance[np.ix_(at, at)]

    def intrinsics(self, camera: str) -> Intrinsics:
        own = self.prior_of(camera).intrinsics
        values = self.state.intrinsics[self.cameras.index(camera)]
        return own.with_vector(values[: len(own.vector)])

    def depth_bias(self, camera: str) -> DepthBias | None:
        """The depth bias of a camera with depth on the board; its RMS is what depth is off by after the correction."""
        i, prior = self.cameras.index(camera), self.prior_of(camera).bias
        block = self.problem.block("depth bias")
        assert isinstance(block, DepthBiasBlock)
        if not self.has_depth[i]:
            return prior
        n = block.n_own(i)
        at, ripple = self.index("depth bias", camera)[:n], ()
        if "depth ripple" in self.problem.parts and self.prior_of(camera).time_of_flight:
            at = np.concatenate([at, self.index("depth ripple", camera)])
            ripple = tuple(self.state.values["depth ripple"][i].tolist())
        low, high = (float(z) for z in block.range_m[i])
        coefficients = tuple(float(c) for c in self.state.values["depth bias"][i, :n])
        first, last = (float(z) for z in block.data_m[i])
        data_m = None if (first, last) == (low, high) else (first, last)
        covariance = self.covariance[np.ix_(at, at)]
        along_ray = block.along_ray(i)
        return DepthBias(coefficients, low, high, self.depth_rms_m(camera), covariance, ripple, along_ray, data_m)

    def depth_field(self, camera: str) -> DepthField | None:
        """What its depth errs by over the image; None where that is held at zero."""
        i = self.cameras.index(camera)
        if (
            "depth field" not in self.problem.parts
            or not self.problem.prior.free[self.index("depth field", camera)].any()
        ):
            return None
        lens, at = self.prior_of(camera).intrinsics, self.index("depth field", camera)
        block, field = self.problem.block("depth bias"), self.problem.block("depth field")
        assert isinstance(block, DepthBiasBlock) and isinstance(field, depth_field.DepthField)
        low, high = (float(z) for z in block.range_m[i])
        own = self.state.values["depth field"][i]
        pattern = self._pattern(i, float(field.at_m[i]))
        size, covariance = (lens.width, lens.height), self.covariance[np.ix_(at, at)]
        growth, at_m = (float(own[-2]), float(own[-1])), float(field.at_m[i])
        return PolynomialField(*size, depth_field.DEGREE, growth, own[:-2], low, high, covariance, pattern, at_m)

    def _pattern(self, i: int, at_m: float) -> CellPattern | None:
        """What is finer than the smooth field, as walls showed it, with the variance of what the boards' depths say is left."""
        pattern = self.problem.local[i] if self.problem.local else None
        shared = float(self.common.depth_image[i] * self.problem.weights.k_depth[i])  # times z^2
        if shared == 0 or (pattern is not None and pattern.variance_m2(np.array(at_m)) > (shared * at_m**2) ** 2):
            return pattern
        powers, values = ((2,), np.zeros((1, 1, 1))) if pattern is None else (pattern.powers, pattern.values)
        return CellPattern(powers, values, np.diag([shared**2 if power == 2 else 0.0 for power in powers]))

    def depth_camera(self, camera: str) -> DepthCamera | None:
        """The camera that its depth image is of, where that is not quite the colour camera; None without depth."""
        i = self.cameras.index(camera)
        if "registration" not in self.problem.parts or not self.has_depth[i] or self.prior_of(camera).same_sensor:
            return None
        tilt_rad = self.state.values["depth tilt"][i] if "depth tilt" in self.problem.parts else np.zeros(2)
        return registration.depth_camera(self.intrinsics(camera), self.state.values["registration"][i], tilt_rad)

    def depth_rms_m(self, camera: str) -> float:
        """RMS of the depth residuals that were used, metres."""
        obs = self.problem.obs
        mine = obs.has_depth & (obs.camera == self.cameras.index(camera))[:, None]
        return float(np.sqrt(np.mean(self.residuals[1][mine] ** 2))) if mine.any() else 0.0

    def board_poses(self) -> dict[str, FloatArray]:
        """T_world_board (4, 4) of the frames that several cameras see."""
        obs = self.problem.obs
        shared = {int(f) for f, s in zip(obs.frame, obs.shared, strict=True) if s}
        return {frame: self.state.boards.T_parent_board[f] for f, frame in enumerate(self.course.frames) if f in shared}

    @cached_property
    def board_shape(self) -> BoardShape:
        """Where the board's corners were found to be, with standard deviations."""
        problem, M = self.problem, self.problem.setup.board.n_corners
        corners_m = problem.board_corners_m(self.state)
        variance = np.zeros((2, M, 3))
        blocks = [b for b in problem.blocks if isinstance(b, BoardShapeBlock)]
        at = np.concatenate([np.zeros(0, int), *(problem.index(b.name) for b in blocks)])
        C = self.covariance[np.ix_(at, at)]
        for axis in range(3):
            own = (b.table()[:, :, axis].reshape(2 * M, -1) for b in blocks)
            J = np.concatenate([np.zeros((2 * M, 0)), *own], axis=1)
            variance[:, :, axis] = np.einsum("kp,pq,kq->k", J, C, J).reshape(2, M)
        sd_m = np.sqrt(np.maximum(variance, 0.0))
        if problem.setup.board.two_sided:
            return BoardShape(corners_m[0], corners_m[1], sd_m[0], sd_m[1])
        return BoardShape(corners_m[0], None, sd_m[0])

    def camera_statistics(self, camera: str) -> CameraStatistics:
        """Of one camera, for the rig file."""
        i, obs, weights = self.cameras.index(camera), self.problem.obs, self.problem.weights
        mine = obs.camera == i
        pixels, depths = obs.has_pixel & mine[:, None], obs.has_depth & mine[:, None]
        n = len(self.prior_of(camera).intrinsics.vector)
        sd = np.sqrt(np.diag(self.covariance)[self.index("intrinsics", camera)])[:n]
        out = CameraStatistics(
            intrinsics_sd=tuple(sd.tolist()),
            sigma_2d_px=float(weights.sigma_2d_px[i]),
            rms_px=float(np.sqrt(np.mean(self.residuals[0][pixels] ** 2))) if pixels.any() else None,
            views=int(pixels.any(axis=1).sum()),
            corners=int(pixels.sum()),
            corners_with_depth=int(depths.sum()),
        )
        if depths.any():
            k = float(weights.k_depth[i])
            out = replace(
                out,
                sigma_3d_m=k * float(np.mean(obs.depth_m[depths] ** 2)),
                sigma_3d_model="along the optical axis, k z^2, mean over a corner's cell; sigma_3d_m at the mean z^2",
                depth_k_per_m=k,
                depth_rms_m=self.depth_rms_m(camera),
            )
        return out

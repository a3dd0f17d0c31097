"""A long recording calibrated from the frames that tell most, and what the others would have added."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.recording import Recording
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.depth_cameras import without_corners
from rgbd_calib.pipeline.prepare import DepthSource, IntrinsicsSource
from rgbd_calib.quality import ExpectedAlignment, SelectedFrames
from rgbd_calib.rig.blocks import Scope
from rgbd_calib.rig.frame_selection import FrameChoice, choose_frames
from rgbd_calib.rig.observations import Walls
from rgbd_calib.rig.setup import BundleParams, CameraPrior, MountPrior
from rgbd_calib.trust.uncertainty import JointCovariance, expected_alignment, volume
from rgbd_calib.types import Board, DepthBias, PlacedView, Rig, RigCamera
from rgbd_calib.views.association import AssociationResult, label_views
from rgbd_calib.views.board_pose import pose_view
from rgbd_calib.views.plane_filter import filter_planes

GRID = 5
"""Points along each side of the working volume: enough for a mean."""


@dataclass(frozen=True)
class Selection:
    """The frames of the board that are used, of how many, and how much surer all of them would be."""

    used: tuple[str, ...]
    left_out: tuple[str, ...]
    ratio: float
    """Expected alignment error with these frames over that with all, by the equations at the start; NaN where no two cameras
    have depth on a common place."""

    def quality(self, expected: ExpectedAlignment | None) -> SelectedFrames:
        """For the rig file; `expected` is what the calibration expects of itself."""
        out = SelectedFrames(len(self.used) + len(self.left_out), len(self.used), self.left_out)
        if np.isfinite(self.ratio):
            out = replace(out, error_over_that_of_all=round(self.ratio, 4))
            if expected is not None:
                mm = expected.mean_mm
                out = replace(out, expected_mm=round(mm, 4), expected_mm_with_all=round(mm / self.ratio, 4))
        return out


def told(own: SelectedFrames) -> str:
    """The selection in a sentence."""
    text = f"{own.used} of {own.frames} frames used, the most informative"
    if own.expected_mm is not None:
        return f"{text}: expected error {own.expected_mm:.2f} mm in the mean, {own.expected_mm_with_all:.2f} mm estimated with all"
    if own.error_over_that_of_all is not None:
        return f"{text}: the expected error is {own.error_over_that_of_all:.2f} times that with all"
    return text


def bundle_priors(
    lenses: IntrinsicsSource, depth: DepthSource, recording: Recording, params: BundleParams
) -> dict[str, CameraPrior]:
    """What is known of each camera before the bundle."""
    mounted = without_corners(recording)
    sd = np.repeat([params.mount_turn_sd_rad, params.mount_shift_sd_m], 3)
    return {
        name: CameraPrior(
            lenses.intrinsics[name],
            lenses.standard_deviations.get(name),
            name in lenses.results,
            depth.biases.get(name),
            depth_unit_m=info.depth_step_m,
            bias_is_start=name in depth.walls,
            time_of_flight=info.time_of_flight,
            same_sensor=info.mount is not None,
            mount=MountPrior(mounted[name].camera, sd) if name in mounted else None,
        )
        for name, info in recording.cameras.items()
    }


def views_alone(
    lenses: IntrinsicsSource,
    biases: dict[str, DepthBias],
    recording: Recording,
    T_world_color: Mapping[str, FloatArray],
    board: Board,
    config: Config,
) -> list[PlacedView]:
    """Views of an intrinsic recording, each of a board of its own; a colour camera and its depth camera share theirs."""
    posed = []
    for view in filter_planes(lenses.views, lenses.intrinsics, biases, config.plane_filter, config.seed).views:
        result = lenses.results.get(view.camera)
        if view.camera in recording.cameras and (result is None or view.frame not in result.dropped):
            mount = recording.cameras[view.camera].mount
            own = view.as_alone(mount.camera if mount else None)
            posed.append(
                pose_view(own, board, lenses.intrinsics[view.camera], biases.get(view.camera), config.board_pose)
            )
    return list(label_views(posed, board, T_world_color, config.association)[0])


def select(
    association: AssociationResult,
    lenses: IntrinsicsSource,
    depth: DepthSource,
    recording: Recording,
    board: Board,
    config: Config,
) -> tuple[AssociationResult, Selection | None]:
    """The association of at most `config.max_views` frames, the most informative; as it is where it has no more.

    Raises
    ------
    CalibrationError
        More frames are needed to keep every pair of cameras.
    """
    frames = {placed.view.frame for placed in association.views}
    if config.max_views is None or len(frames) <= config.max_views:
        return association, None
    choice = choose_frames(
        association.views,
        views_alone(lenses, depth.biases, recording, association.T_world_color, board, config),
        board,
        bundle_priors(lenses, depth, recording, config.bundle),
        association.T_world_color,
        association.reference,
        config.max_views,
        config.bundle,
        Walls.of(list(recording.cameras), depth.walls),
    )
    kept = set(choice.chosen)
    views = tuple(placed for placed in association.views if placed.view.frame in kept)
    with_depth = recording.cameras_with_depth
    ratio = _ratio(choice, association, lenses, depth.biases, with_depth, board)
    return replace(association, views=views), Selection(choice.chosen, choice.left_out, ratio)


def _ratio(
    choice: FrameChoice,
    association: AssociationResult,
    lenses: IntrinsicsSource,
    biases: Mapping[str, DepthBias],
    with_depth: Sequence[str],
    board: Board,
) -> float:
    rig = Rig(
        association.reference,
        {
            name: RigCamera(lenses.intrinsics[name], T, np.zeros((6, 6)), biases.get(name))
            for name, T in association.T_world_color.items()
        },
    )
    points_m = volume(_corners_m(association, board), GRID)
    own = choice.problem
    blocks = [b.name for b in own.blocks if b.scope is Scope.CAMERA]
    parameters = {c: {b: own.index(b, i) for b in blocks} for i, c in enumerate(own.setup.cameras)}
    few, whole = (
        expected_alignment(rig, JointCovariance(covariance, parameters), points_m, with_depth)
        for covariance in (choice.covariance, choice.covariance_of_all)
    )
    if few is None or whole is None:
        return float("nan")
    return float(np.nanmean(few.mean_m) / np.nanmean(whole.mean_m))


def _corners_m(association: AssociationResult, board: Board) -> FloatArray:
    return np.concatenate(
        [
            se3.transform(association.T_world_color[p.view.camera] @ p.T_color_board, board.corners_m())
            for p in association.views
        ]
    )

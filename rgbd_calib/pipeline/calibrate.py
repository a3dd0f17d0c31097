"""From a recording to a rig: the stages in their order (the paper, section 7, and the joint bundle)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.recording import Recording
from rgbd_calib.io.residuals import Residuals
from rgbd_calib.pipeline import depth_cameras, details
from rgbd_calib.pipeline.checked_views import Views, prepare_views
from rgbd_calib.pipeline.color_planes import color_plane_findings
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.depth_cameras import split
from rgbd_calib.pipeline.detection import Detections, Progress, board_of, silent
from rgbd_calib.pipeline.estimators import ESTIMATORS
from rgbd_calib.pipeline.evaluate import Evaluation, common_corners
from rgbd_calib.pipeline.provenance import provenance_of
from rgbd_calib.pipeline.quality import with_views
from rgbd_calib.pipeline.workers import Workers
from rgbd_calib.trust.self_check import calibration as self_check
from rgbd_calib.trust.uncertainty import JointCovariance
from rgbd_calib.types import Correspondences, PlacedView, Rig


@dataclass(frozen=True)
class Calibration:
    """The result, and what the report shows of the way."""

    rig: Rig
    views: Views
    placed: tuple[PlacedView, ...]
    """The views, the boards posed by the final rig."""
    correspondences: Correspondences
    boards: dict[str, FloatArray]
    """T_world_board (4, 4) by frame."""
    residuals: Residuals
    joint: JointCovariance | None
    """Covariance of all cameras together; None for `init`."""
    evaluation: Evaluation | None
    """On the recording itself; None where no two cameras see the board in one frame."""


@one_blas_thread
def calibrate(
    recording: Recording,
    config: Config,
    *,
    intrinsics: Path | None = None,
    depth_bias: Path | None = None,
    detections: Detections | None = None,
    intrinsic_detections: Detections | None = None,
    workers: Workers | None = None,
    progress: Progress = silent,
) -> Calibration:
    """Calibrate a rig from a recording of a board.

    Parameters
    ----------
    intrinsics, depth_bias : a file, or a recording to make them from.
    detections, intrinsic_detections : corners found before, of the recording and of an intrinsic recording; None: find them.

    Raises
    ------
    ConfigError, CalibrationError
        See the stages.
    """
    board, recording = board_of(recording), split(recording)
    views = prepare_views(
        recording, config, intrinsics, depth_bias, detections, workers, progress, intrinsic_detections
    )
    own = ESTIMATORS[config.method](views, recording, config)
    rig, views, placed, boards, residuals, joint = own.rig, own.views, own.placed, own.boards, own.residuals, own.joint
    evaluation = common_corners(rig, placed, own.board)
    quality = with_views(rig.quality, recording, views, placed, evaluation)
    first = details.starting_rig(
        *(views.association.views, views.association.T_world_color, views.lenses.intrinsics),
        *(board, rig.reference, config.initialization),
    )
    expected = None
    if joint is not None:
        with_depth = recording.cameras_with_depth
        corners_m = np.concatenate([se3.transform(T, board.corners_m()) for T in boards.values()])
        expected = details.expectation(rig, joint, corners_m, with_depth)
    checked = self_check.of_calibration(
        own.solution,
        residuals,
        views.detections.views,
        views.association,
        board,
        recording.frames,
        0.0 if expected is None else expected.mean_mm,
        config.self_check,
        color_plane_findings(recording, board, views.detections.views),
    )
    measured = quality.alignment_on_recording
    quality = replace(
        quality,
        method=config.method,
        start=first,
        expected_alignment=expected and replace(expected, pairs=depth_cameras.by_device(expected.pairs)),
        alignment_on_recording=measured and replace(measured, pairs=depth_cameras.by_device(measured.pairs)),
        frame_selection=None if views.selection is None else views.selection.quality(expected),
        self_check=checked,
        board=own.board,
        depth_bias_samples=views.depth.samples,
    )
    provenance = {
        **provenance_of(config),
        "recording": str(recording.path),
        "recording_sha256": recording.digest(),
        "images_sha256": recording.image_digests(),
        "intrinsics": views.lenses.origin,
        "depth_bias": views.depth.origin,
    }
    rig = replace(depth_cameras.joined(rig, recording.cameras, joint), quality=quality, provenance=provenance)
    return Calibration(rig, views, placed, own.correspondences, boards, residuals, joint, evaluation)

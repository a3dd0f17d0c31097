"""From a recording of a carried board to a rig with clocks, as :func:`rgbd_calib.pipeline.calibrate.calibrate` gives it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.io.recording import Recording
from rgbd_calib.io.residuals import Residuals
from rgbd_calib.pipeline import details
from rgbd_calib.pipeline.calibrate import Calibration
from rgbd_calib.pipeline.carried_calibration import CarriedSolution, clock_quality, solve_carried
from rgbd_calib.pipeline.checked_views import Views, reference_of
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.depth_cameras import by_device, joined, split
from rgbd_calib.pipeline.detection import Detections, Progress, board_of, detect, silent
from rgbd_calib.pipeline.estimators import rig_of_bundle
from rgbd_calib.pipeline.provenance import provenance_of
from rgbd_calib.pipeline.quality import bundle_quality, with_views
from rgbd_calib.pipeline.workers import Workers
from rgbd_calib.quality import ExpectedAlignment, SelfCheck
from rgbd_calib.rig.motion.estimate import frame_name
from rgbd_calib.trust.self_check import calibration as self_check
from rgbd_calib.types import Board
from rgbd_calib.views.correspondence import correspond


@one_blas_thread
def calibrate_carried(
    recording: Recording,
    config: Config,
    *,
    intrinsics: Path | None = None,
    depth_bias: Path | None = None,
    detections: Detections | None = None,
    workers: Workers | None = None,
    progress: Progress = silent,
) -> Calibration:
    """Calibrate a rig and the clocks of its cameras; parameters as for a synchronous recording.

    Raises
    ------
    ConfigError, CalibrationError
        See :func:`rgbd_calib.pipeline.carried_calibration.solve_carried`.
    """
    board, recording = board_of(recording), split(recording)
    reference = reference_of(config, recording.color_cameras)
    detections = detections or detect(recording, config.detect, workers, progress)
    own = solve_carried(recording, config, detections, reference, intrinsics, depth_bias, workers, progress)
    solved, boards = own.solution, own.board_poses()
    rig = rig_of_bundle(solved, reference)
    rig = replace(rig, cameras={c: replace(camera, clock=own.clocks.get(c)) for c, camera in rig.cameras.items()})
    named = tuple(replace(p, view=replace(p.view, frame=frame_name(p))) for p in own.placed)
    views = Views(detections, own.lenses, own.depth, own.filtered, own.start.association)
    data = correspond(named, board, views.given)
    residuals, joint = details.residuals_of_bundle(solved, board), details.joint_of_bundle(solved)
    with_depth = recording.cameras_with_depth
    corners_m = np.concatenate([se3.transform(T, board.corners_m()) for T in boards.values()])
    expected = details.expectation(rig, joint, corners_m, with_depth)
    quality = replace(
        with_views(bundle_quality(solved), recording, views, own.placed, None),
        method=config.method,
        carried=clock_quality(own, reference),
        expected_alignment=expected and replace(expected, pairs=by_device(expected.pairs)),
        board=replace(board, shape=solved.board_shape),
        depth_bias_samples=own.depth.samples,
        self_check=_self_check(own, residuals, detections, board, expected, config),
    )
    provenance = {
        **provenance_of(config),
        "recording": str(recording.path),
        "recording_sha256": recording.digest(),
        "intrinsics": own.lenses.origin,
        "depth_bias": own.depth.origin,
    }
    rig = replace(joined(rig, recording.cameras, joint), quality=quality, provenance=provenance)
    return Calibration(rig, views, named, data, boards, residuals, joint, None)


def _self_check(
    own: CarriedSolution,
    residuals: Residuals,
    detections: Detections,
    board: Board,
    expected: ExpectedAlignment | None,
    config: Config,
) -> SelfCheck:
    """As for still boards; each view is a frame, under the name that the solution has for it, in order of its estimated time."""
    left_out = {(camera, f"{camera} {frame}"): why for (camera, frame), why in own.start.left_out.items()}
    names = tuple(replace(v, frame=f"{v.camera} {v.frame}") for v in detections.views)
    association = replace(own.start.association, dropped=left_out)
    stated_mm = 0.0 if expected is None else expected.mean_mm
    return self_check.of_calibration(
        own.solution, residuals, names, association, board, own.frames_in_time(), stated_mm, config.self_check
    )

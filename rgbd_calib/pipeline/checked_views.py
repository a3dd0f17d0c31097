"""The views that every estimator starts from: found, freed of outliers, posed, and with known corners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.io.recording import Recording
from rgbd_calib.pipeline import frame_selection
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.detection import Detections, Progress, board_of, detect, silent
from rgbd_calib.pipeline.planes_of_depth import with_depth_cameras
from rgbd_calib.pipeline.prepare import (
    DepthSource,
    IntrinsicsSource,
    check_sources,
    check_together,
    resolve_depth,
    resolve_intrinsics,
)
from rgbd_calib.pipeline.workers import Workers
from rgbd_calib.types import PlacedView, RigCamera, unposed
from rgbd_calib.views.association import AssociationResult, associate
from rgbd_calib.views.board_pose import pose_view
from rgbd_calib.views.depth_scale import check_axis, check_depth_scale
from rgbd_calib.views.plane_filter import PlaneFilterResult, filter_planes


@dataclass(frozen=True)
class Views:
    """What all estimators start from: checked views, and rough poses."""

    detections: Detections
    lenses: IntrinsicsSource
    depth: DepthSource
    filtered: PlaneFilterResult
    association: AssociationResult
    selection: frame_selection.Selection | None = None
    """The frames that tell most, where not all are used."""

    @property
    def given(self) -> dict[str, RigCamera]:
        """Lens and depth bias of each camera as they are known before the poses; all poses are the identity."""
        return unposed(self.lenses.intrinsics, self.depth.biases)

    def read_as(self, solved: Sequence[PlacedView]) -> Views:
        """With the faces that a solution decided on."""
        read = {(p.view.camera, p.view.frame): p for p in solved}
        views = tuple(read[p.view.camera, p.view.frame] for p in self.association.views)
        return replace(self, association=replace(self.association, views=views))


def prepare_views(
    recording: Recording,
    config: Config,
    intrinsics: Path | None = None,
    depth_bias: Path | None = None,
    detections: Detections | None = None,
    workers: Workers | None = None,
    progress: Progress = silent,
    intrinsic_detections: Detections | None = None,
) -> Views:
    """Detect, filter, and decide which corner is which."""
    board = board_of(recording)
    cameras = list(recording.cameras)
    reference = reference_of(config, recording.color_cameras)
    if len(cameras) < 2:
        raise CalibrationError(
            f"{recording.path}: 1 camera ({cameras[0]}), two or more needed for a rig. Record the board with another camera, "
            "or calibrate this one alone with `rgbd-calib intrinsics` and `rgbd-calib depth-bias`"
        )
    check_together(recording)
    check_sources(recording, intrinsics, depth_bias)
    detections = detections or detect(recording, config.detect, workers, progress)
    _need_depth(recording, detections)
    lenses = resolve_intrinsics(intrinsics, recording, detections, config, workers, progress, intrinsic_detections)
    depth = resolve_depth(depth_bias, recording, lenses.intrinsics, config, workers, progress)
    biases = depth.biases
    filtered = filter_planes(detections.views, lenses.intrinsics, biases, config.plane_filter, config.seed)
    posed = [
        pose_view(view, board, lenses.intrinsics[view.camera], biases.get(view.camera), config.board_pose)
        for view in filtered.views
    ]
    check_depth_scale(posed, board, biases, config.bundle.bias_scale_sd)
    check_axis(posed, board)
    seeing = [name for name in cameras if recording.color_files[name]]
    association = associate(posed, board, reference, seeing, config.association)
    association = with_depth_cameras(association, recording, lenses.intrinsics, biases, board, config)
    association, selection = frame_selection.select(association, lenses, depth, recording, board, config)
    return Views(detections, lenses, depth, filtered, association, selection)


def _need_depth(recording: Recording, detections: Detections) -> None:
    """Raise CalibrationError where depth images of a camera hold nothing on the board, in any view of it."""
    for name, info in recording.cameras.items():
        views = [v for v in detections.of(name) if recording.has_depth(name, v.frame)]
        if views and info.mount is None and not any(np.isfinite(v.depth_m).any() for v in views):
            raise CalibrationError(
                f"{name}: depth on the board expected, no measurement found in its {len(views)} depth images that should show it. "
                "Look at one: is it empty, of another camera, or the board out of range? If the camera has no depth, take its depth "
                "images out"
            )


def reference_of(config: Config, cameras: Sequence[str]) -> str:
    """The camera whose frame is the world."""
    reference = cameras[0] if config.reference is None else config.reference
    if reference not in cameras:
        raise ConfigError(f"reference: '{reference}' seen, one of {', '.join(cameras)} needed. Choose one of them")
    return reference

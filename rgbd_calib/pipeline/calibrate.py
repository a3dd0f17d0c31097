"""From a recording to a rig: the stages in their order (the paper, section 7, and the joint bundle)."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import rgbd_calib
from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.files import plain
from rgbd_calib.io.recording import Recording
from rgbd_calib.io.residuals import Residuals
from rgbd_calib.pipeline import depth_cameras, details, frame_selection
from rgbd_calib.pipeline.color_planes import color_plane_findings
from rgbd_calib.pipeline.config import Config, as_plain
from rgbd_calib.pipeline.depth_cameras import split
from rgbd_calib.pipeline.detection import Detections, Progress, board_of, detect, silent
from rgbd_calib.pipeline.evaluate import Evaluation, against_views
from rgbd_calib.pipeline.judged_points import with_alignment
from rgbd_calib.pipeline.prepare import (
    NO_DEPTH_SOURCE,
    DepthSource,
    IntrinsicsSource,
    check_sources,
    check_together,
    resolve_depth,
    resolve_intrinsics,
)
from rgbd_calib.pipeline.quality import bundle_quality, finite, initial_quality, with_views
from rgbd_calib.pipeline.workers import Workers
from rgbd_calib.quality import CameraStatistics
from rgbd_calib.rig.biobjective import RefinementParams, RefinementResult, refine
from rgbd_calib.rig.bundle import bundle, free_structure
from rgbd_calib.rig.initialization import initialize
from rgbd_calib.rig.observations import Walls
from rgbd_calib.rig.solution import Solution
from rgbd_calib.trust.self_check import calibration as self_check
from rgbd_calib.trust.uncertainty import JointCovariance
from rgbd_calib.types import Board, BoardView, Correspondences, DepthBias, PlacedView, PosedView, Rig, RigCamera
from rgbd_calib.views.association import AssociationResult, associate
from rgbd_calib.views.board_pose import pose_view, repose
from rgbd_calib.views.correspondence import correspond
from rgbd_calib.views.depth_scale import check_depth_scale
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

    def read_as(self, solved: Sequence[PlacedView]) -> Views:
        """With the faces that a solution decided on."""
        read = {(p.view.camera, p.view.frame): p for p in solved}
        views = tuple(read[p.view.camera, p.view.frame] for p in self.association.views)
        return replace(self, association=replace(self.association, views=views))


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
    cameras = list(recording.cameras)
    reference = views.association.reference
    lenses, biases = views.lenses.intrinsics, views.depth.biases
    data = correspond(views.association.views, board, lenses, biases, cameras)
    residuals: Residuals | None = None
    joint: JointCovariance | None = None
    solution: Solution | RefinementResult | None = None
    if config.method == "bundle":
        solution = solved = _bundle(views, board, recording, config, reference)
        if config.bundle.structure == "free":
            solved = free_structure(solved)
        views = views.read_as(solved.course.views)
        boards, rig = solved.board_poses(), rig_of_bundle(solved, reference)
        residuals, joint = details.residuals_of_bundle(solved, board), details.joint_of_bundle(solved)
        quality = bundle_quality(solved)
    else:
        start = initialize(data, lenses, reference, config.initialization)
        boards = {}
        if config.method == "init":
            rig = _rig_of_poses(start.T_world_color, {}, views, reference)
            quality = initial_quality(start)
        else:
            params = _refinement(config)
            solution = refined = refine(data, lenses, start.T_world_color, reference, params)
            rig = _rig_of_refinement(refined, views, reference)
            quality = initial_quality(start, refined)
            residuals = details.residuals_of_refinement(refined, data, views.association.views, board)
            joint = details.joint_of_refinement(refined)
    found = replace(board, shape=solution.board_shape) if isinstance(solution, Solution) else board
    placed = pose_by_rig(rig, views.association.views, found, config)
    placed = depth_cameras.at_the_corners(placed, rig, recording.cameras, found)
    boards = boards or {p.view.frame: rig.cameras[p.view.camera].T_world_color @ p.T_color_board for p in placed}
    evaluation = against_views(rig, placed, found) if _common_frames(placed) else None
    residuals = residuals or details.residuals_of_rig(rig, placed, boards, board)
    quality = with_views(quality, recording, views, placed, evaluation)
    first = details.starting_rig(
        views.association.views, views.association.T_world_color, lenses, board, reference, config.initialization
    )
    expected = None
    if joint is not None:
        with_depth = [name for name in cameras if recording.depth_files[name]]
        corners_m = np.concatenate([se3.transform(T, board.corners_m()) for T in boards.values()])
        expected = details.expectation(rig, joint, corners_m, with_depth)
    checked = self_check.of_calibration(
        solution,
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
        board=found,
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
    return Calibration(rig, views, placed, data, boards, residuals, joint, evaluation)


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
    reference = reference_of(config, [name for name, info in recording.cameras.items() if info.mount is None])
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
    seeing = [name for name in cameras if recording.color_files[name]]
    association = associate(posed, board, reference, seeing, config.association)
    association = _with_depth_cameras(association, recording, lenses, biases, board, config)
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


def _with_depth_cameras(
    association: AssociationResult,
    recording: Recording,
    lenses: IntrinsicsSource,
    biases: dict[str, DepthBias],
    board: Board,
    config: Config,
) -> AssociationResult:
    """With the depth cameras that see no corners: where they are thought to be, and their depth of the board."""
    mounted = depth_cameras.without_corners(recording)
    if not mounted:
        return association
    if config.method != "bundle":
        raise ConfigError(
            f"{recording.path}: depth of {', '.join(m.camera for m in mounted.values())} is not registered to colour, and has no "
            f"infrared images; method {config.method} needs registered depth. Take method bundle, or register it first, with "
            "`rgbd-calib calibrate` and `rgbd-calib correct`"
        )
    poses = dict(association.T_world_color)
    for name, mount in mounted.items():
        assert mount.T_color_depth is not None  # seen to with the lenses
        poses[name] = poses[mount.camera] @ mount.T_color_depth
    poses = {name: poses[name] for name in recording.cameras}
    read = depth_cameras.predicted_views(association.views, recording, lenses.intrinsics, poses, board)
    on_plane = filter_planes([p.view for p in read], lenses.intrinsics, biases, config.plane_filter, config.seed)
    views = [replace(p, view=view) for p, view in zip(read, on_plane.views, strict=True)]
    posed = [PosedView(p.view, p.T_color_board @ board.T_face_board(p.back, p.turned), 0.0) for p in views]
    check_depth_scale(posed, board, biases, config.bundle.bias_scale_sd)
    return replace(association, views=(*association.views, *views), T_world_color=poses)


def reference_of(config: Config, cameras: Sequence[str]) -> str:
    """The camera whose frame is the world."""
    reference = cameras[0] if config.reference is None else config.reference
    if reference not in cameras:
        raise ConfigError(f"reference: '{reference}' seen, one of {', '.join(cameras)} needed. Choose one of them")
    return reference


@one_blas_thread
def refine_correspondences(
    data: Correspondences, lenses: IntrinsicsSource, config: Config, reference: str
) -> tuple[Rig, RefinementResult | None]:
    """The paper's estimators on bare numbers."""
    start = initialize(data, lenses.intrinsics, reference, config.initialization)
    views = _no_views(lenses)
    if config.method == "init":
        rig = _rig_of_poses(start.T_world_color, {}, views, reference)
        quality, refined = initial_quality(start), None
    else:
        params = _refinement(config)
        refined = refine(data, lenses.intrinsics, start.T_world_color, reference, params)
        rig = _rig_of_refinement(refined, views, reference)
        checked = self_check.of_correspondences(refined, data, config.self_check)
        quality = replace(initial_quality(start, refined), self_check=checked)
    joint = None if refined is None else details.joint_of_refinement(refined)
    quality = with_alignment(replace(quality, method=config.method), rig, data, joint)
    return replace(rig, quality=quality), refined


def pose_by_rig(rig: Rig, views: Sequence[PlacedView], board: Board, config: Config) -> tuple[PlacedView, ...]:
    """The same views, each board posed by its own pixels through the rig's intrinsics."""
    out = []
    for placed in views:
        own = rig.cameras[placed.view.camera]
        posed = pose_view(placed.view, board, own.intrinsics, own.depth_bias, config.board_pose)
        flat = replace(placed, T_color_board=posed.T_color_face @ board.T_face_board(placed.back, placed.turned))
        out.append(repose(flat, board, own.intrinsics))
    return tuple(out)


def provenance_of(config: Config) -> dict[str, Any]:
    """Which program, run how."""
    return {
        "program": f"rgbd-calib {rgbd_calib.__version__}",
        "versions": details.versions(),
        "command": _command(),
        "seed": config.seed,
        "config": plain(as_plain(config)),
    }


def _command() -> str:
    """As it was typed; the name of the script where a Python program called."""
    script = Path(sys.argv[0]).name
    return shlex.join(["rgbd-calib" if script in ("__main__.py", "rgbd-calib.exe") else script, *sys.argv[1:]])


def _refinement(config: Config) -> RefinementParams:
    if config.method == "init" or config.method == "bundle":
        raise ValueError(f"{config.method} is no method of the refinement")
    return replace(config.refinement, method=config.method)


def _bundle(views: Views, board: Board, recording: Recording, config: Config, reference: str) -> Solution:
    """The joint bundle over the recording's views and those of an intrinsic recording."""
    cameras = list(recording.cameras)
    priors = frame_selection.bundle_priors(views.lenses, views.depth, recording, config.bundle)
    start = views.association.T_world_color
    single = frame_selection.views_alone(views.lenses, views.depth.biases, recording, start, board, config)
    walls = Walls.of(cameras, views.depth.walls)
    return bundle([*views.association.views, *single], board, priors, start, reference, config.bundle, walls)


def rig_of_bundle(solved: Solution, reference: str) -> Rig:
    cameras = {}
    for name in solved.cameras:
        cameras[name] = RigCamera(
            solved.intrinsics(name),
            solved.T_world_color(name),
            solved.pose_covariance(name),
            solved.depth_bias(name),
            solved.camera_statistics(name),
            solved.depth_field(name),
            solved.depth_camera(name),
        )
    return Rig(reference, cameras)


def _rig_of_poses(
    T_world_color: Mapping[str, FloatArray], covariance: Mapping[str, FloatArray], views: Views, reference: str
) -> Rig:
    cameras = {
        name: RigCamera(
            views.lenses.intrinsics[name], T, covariance.get(name, np.zeros((6, 6))), views.depth.biases.get(name)
        )
        for name, T in T_world_color.items()
    }
    return Rig(reference, cameras)


def _rig_of_refinement(refined: RefinementResult, views: Views, reference: str) -> Rig:
    rig = _rig_of_poses(refined.T_world_color, refined.covariance, views, reference)
    cameras = {}
    for name, own in rig.cameras.items():
        pixel, point = finite(refined.sigmas_2d_px[name]), finite(refined.sigmas_3d_m[name])
        model = None if point is None else "isotropic, for each coordinate"
        statistics = CameraStatistics(sigma_2d_px=pixel, sigma_3d_m=point, sigma_3d_model=model)
        cameras[name] = replace(own, statistics=statistics)
    return replace(rig, cameras=cameras)


def _common_frames(placed: Sequence[PlacedView]) -> bool:
    frames = [p.view.frame for p in placed]
    return len(frames) > len(set(frames))


def _no_views(lenses: IntrinsicsSource) -> Views:
    empty: tuple[BoardView, ...] = ()
    nothing = AssociationResult((), {}, {}, (), "")
    return Views(Detections(empty, ()), lenses, NO_DEPTH_SOURCE, PlaneFilterResult(empty, 0, ()), nothing)

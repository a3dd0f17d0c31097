"""One camera posed anew against a rig that stands, or added to it; the others stay as they are.

The others' poses, lenses and depth biases are held, and the joint bundle solves for the one camera, the boards and the
board's bow. A camera that the rig has keeps its lens and depth bias unless others are given; a new one is calibrated whole.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.recording import Recording
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.detection import Detections, Progress, silent
from rgbd_calib.pipeline.evaluate import against_views, place_views
from rgbd_calib.pipeline.prepare import IntrinsicsSource, resolve_depth, resolve_intrinsics
from rgbd_calib.pipeline.rig_inputs import board_for, common_cameras
from rgbd_calib.pipeline.verify import verify_views
from rgbd_calib.pipeline.workers import Workers
from rgbd_calib.quality import AlignmentNumbers, CameraUpdate, overlaid
from rgbd_calib.rig.bundle import bundle
from rgbd_calib.rig.setup import CameraPrior
from rgbd_calib.rig.solution import Solution
from rgbd_calib.trust.displacement import VerdictParams
from rgbd_calib.types import Board, BoardView, DepthBias, PlacedView, PosedView, Rig, RigCamera
from rgbd_calib.views.association import associate, label_views
from rgbd_calib.views.board_pose import pose_view
from rgbd_calib.views.plane_filter import filter_planes

_OTHERS = "the rig's other cameras"
MAX_OTHERS_M = 0.010
"""Where the others disagree by more, a camera posed against them would be wrong."""


@dataclass(frozen=True)
class Update:
    """The camera's new entry, and what to say of it."""

    camera: str
    entry: RigCamera
    report: CameraUpdate


@one_blas_thread
def update_camera(
    rig: Rig,
    name: str,
    recording: Recording,
    config: Config,
    detections: Detections,
    *,
    intrinsics: Path | None = None,
    depth_bias: Path | None = None,
    workers: Workers | None = None,
    progress: Progress = silent,
) -> Update:
    """Pose camera `name` against the rig's other cameras.

    Raises
    ------
    ConfigError
        The recording has no such camera, or none of the others.
    CalibrationError
        No common views, or the others no longer fit each other.
    """
    board = board_for(recording, rig)
    others = _others(rig, name, recording)
    source, bias, own = _own(rig, name, recording, config, detections, intrinsics, depth_bias, workers, progress)
    known = {c: rig.cameras[c] for c in others}
    lenses = {c: camera.intrinsics for c, camera in known.items()} | {name: source.intrinsics[name]}
    biases = {c: camera.depth_bias for c, camera in known.items() if camera.depth_bias is not None}
    biases |= {name: bias} if bias is not None else {}
    views = [v for v in detections.views if v.camera in lenses]
    _check_others(rig, views, board, others, config)
    posed = _pose(views, board, lenses, biases, config)
    T_world_color = {c: camera.T_world_color for c, camera in known.items()}
    T_world_color[name] = _rough_pose(posed, board, T_world_color, name, config)
    placed, left_out = label_views(posed, board, T_world_color, config.association)
    units = {c: info.depth_step_m for c, info in recording.cameras.items()}
    priors = {c: CameraPrior(lenses[c], None, False, biases.get(c), "all", units[c]) for c in others}
    priors[name] = CameraPrior(
        lenses[name],
        source.standard_deviations.get(name),
        name in source.results,
        bias,
        "nothing" if own is None else "intrinsics",
        units[name],
    )
    single = _pose(source.views, board, lenses, biases, config) if own is None else []
    alone = [_alone(p) for p in single if p.view.camera == name]
    solved = bundle([*placed, *alone], board, priors, T_world_color, others[0], config.bundle)
    entry = _entry(rig, solved, name, own, placed, others)
    checked = replace(rig, cameras=rig.cameras | {name: entry})
    mine = place_views(checked, views, board, [*others, name], config)
    report = CameraUpdate(
        name,
        was_in_rig=name in rig.cameras,
        recording=str(recording.path),
        recording_sha256=recording.digest(),
        intrinsics="the rig's" if own is not None else source.origin,
        views=sum(p.view.camera == name for p in placed),
        common_frames={c: _common(placed, name, c) for c in others},
        left_out={f"{c} {f}": why for (c, f), why in (left_out | dict(solved.course.dropped)).items() if c == name},
        alignment=_alignment(checked, mine, board, name),
    )
    if name in rig.cameras:
        moved_m, turned_rad = se3.moved(rig.cameras[name].T_world_color, entry.T_world_color)
        report = replace(report, moved_mm=1e3 * moved_m, turned_deg=float(np.degrees(turned_rad)))
    return Update(name, entry, report)


def _others(rig: Rig, name: str, recording: Recording) -> tuple[str, ...]:
    if name not in recording.cameras:
        raise ConfigError(
            f"--only {name}: the recording has {', '.join(recording.cameras)}. Name one of them, or film {name} too"
        )
    others = tuple(c for c in recording.cameras if c in rig.cameras and c != name)
    if not others:
        raise ConfigError(
            f"{recording.path}: no camera of the rig besides {name}; the rig has {', '.join(rig.cameras)}, one of them is "
            f"needed to pose {name} against. Film the board between {name} and another camera"
        )
    common_cameras(recording, replace(rig, cameras={c: rig.cameras[c] for c in others}))
    return others


def _own(
    rig: Rig,
    name: str,
    recording: Recording,
    config: Config,
    detections: Detections,
    intrinsics: Path | None,
    depth_bias: Path | None,
    workers: Workers | None,
    progress: Progress,
) -> tuple[IntrinsicsSource, DepthBias | None, RigCamera | None]:
    """The camera's lens and depth bias, and its entry of the rig where these are kept."""
    if name in rig.cameras and intrinsics is None and depth_bias is None:
        own = rig.cameras[name]
        common_cameras(recording, replace(rig, cameras={name: own}))
        return IntrinsicsSource({name: own.intrinsics}, "the rig", {}, (), {}), own.depth_bias, own
    alone = replace(recording, cameras={name: recording.cameras[name]})
    found = Detections(detections.of(name), tuple(key for key in detections.missed if key[0] == name))
    source = resolve_intrinsics(intrinsics, alone, found, config, workers, progress)
    biases = resolve_depth(depth_bias, alone, source.intrinsics, config, workers, progress).biases
    if depth_bias is None and name in rig.cameras and rig.cameras[name].depth_bias is not None:
        return source, rig.cameras[name].depth_bias, None
    return source, biases.get(name), None


def _check_others(rig: Rig, views: Sequence[BoardView], board: Board, others: Sequence[str], config: Config) -> None:
    """Raise CalibrationError where the cameras that are to be trusted disagree among themselves."""
    try:
        result = verify_views(rig, views, board, others, config, VerdictParams(max_m=MAX_OTHERS_M))
    except CalibrationError:
        return  # one other camera, or no frame in common: nothing to compare
    if result.verdict.moved:
        off = [p for p in result.verdict.pairs if p.broken]
        text = ", ".join(f"{' - '.join(p.cameras)} by {1e3 * p.error_m:.1f} mm" for p in off)
        raise CalibrationError(
            f"the cameras that were to stay are off against each other: {text}; {1e3 * MAX_OTHERS_M:g} mm at most are needed "
            f"to pose another one against them. Did {' and '.join(result.verdict.moved)} move? Calibrate the whole rig"
        )


def _pose(
    views: Sequence[BoardView],
    board: Board,
    lenses: Mapping[str, Intrinsics],
    biases: Mapping[str, DepthBias],
    config: Config,
) -> list[PosedView]:
    mine = [view for view in views if view.camera in lenses]
    kept = filter_planes(mine, dict(lenses), dict(biases), config.plane_filter, config.seed).views
    return [pose_view(v, board, lenses[v.camera], biases.get(v.camera), config.board_pose) for v in kept]


def _rough_pose(
    posed: Sequence[PosedView], board: Board, T_world_color: Mapping[str, FloatArray], name: str, config: Config
) -> FloatArray:
    """T_world_color of `name` that most frames agree on, the rig standing in as one camera at the world's origin."""
    known = [p for p in posed if p.view.camera in T_world_color]
    placed, _ = label_views(known, board, T_world_color, config.association)
    by_rig: dict[str, PosedView] = {}
    for p in placed:
        T_world_board = T_world_color[p.view.camera] @ p.T_color_board
        by_rig.setdefault(p.view.frame, PosedView(replace(p.view, camera=_OTHERS), T_world_board, 0.0))
    mine = [p for p in posed if p.view.camera == name]
    found = associate([*by_rig.values(), *mine], board, _OTHERS, [_OTHERS, name], config.association)
    return found.T_world_color[name]


def _alone(posed: PosedView) -> PlacedView:
    return PlacedView(posed.view.as_alone(), False, False, posed.T_color_face)


def _entry(
    rig: Rig,
    solved: Solution,
    name: str,
    own: RigCamera | None,
    placed: Sequence[PlacedView],
    others: Sequence[str],
) -> RigCamera:
    """The new entry. Its covariance is that of the pose against the others, plus theirs, weighted by common frames.

    However the others' errors hang together, the sum of w_i C_i is no less than the covariance of their weighted mean.
    """
    count = np.array([_common(placed, name, c) for c in others], float)
    carried = sum(
        (w * rig.cameras[c].covariance for w, c in zip(count / max(count.sum(), 1), others, strict=True)),
        np.zeros((6, 6)),
    )
    covariance = solved.pose_covariance(name) + carried
    T = solved.T_world_color(name)
    statistics = solved.camera_statistics(name)
    if own is None:
        return RigCamera(
            solved.intrinsics(name),
            T,
            covariance,
            solved.depth_bias(name),
            statistics,
            solved.depth_field(name),
            solved.depth_camera(name),
        )
    statistics = overlaid(own.statistics, replace(statistics, intrinsics_sd=None))  # its lens is kept
    return replace(own, T_world_color=T, covariance=covariance, statistics=statistics)


def _common(placed: Sequence[PlacedView], a: str, b: str) -> int:
    frames = [{p.view.frame for p in placed if p.view.camera == name} for name in (a, b)]
    return len(frames[0] & frames[1])


def _alignment(rig: Rig, placed: Sequence[PlacedView], board: Board, name: str) -> dict[str, AlignmentNumbers]:
    """How far this camera and the others put the same corner apart, by pair, single depths' noise included."""
    pairs = against_views(rig, placed, board).summary().pairs
    return {pair: numbers for pair, numbers in pairs.items() if name in pair.split(" - ")}

"""The clocks of free-running cameras by a rig that is known, and recordings put on one clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.recording import Recording
from rgbd_calib.pipeline.carried import stamps_s, start_of
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.detection import Detections
from rgbd_calib.pipeline.rig_inputs import board_for, common_cameras
from rgbd_calib.rig.motion.estimate import clock_of, estimate
from rgbd_calib.rig.setup import CameraPrior
from rgbd_calib.types import BoardView, Clock, Rig, RigCamera
from rgbd_calib.views.plane_filter import filter_planes

KNOWN = ("depth field", "bow", "print", "back sheet", "corner offsets")
"""What a few seconds need not tell again: the rig has it."""


@dataclass(frozen=True)
class Timing:
    """Clocks of a rig's cameras, and what they rest on."""

    reference: str
    clocks: dict[str, Clock]
    views: dict[str, int]
    """Used, by camera."""
    left_out: dict[tuple[str, str], str]
    message: str
    remarks: tuple[str, ...]


@one_blas_thread
def sync(recording: Recording, rig: Rig, detections: Detections, config: Config) -> Timing:
    """Clocks alone, everything else being what the rig says.

    Raises
    ------
    ConfigError
        The recording has no stamps, or fits the rig not.
    CalibrationError
        The clocks cannot be determined.
    """
    cameras = [c for c in common_cameras(recording, rig) if recording.color_files[c]]
    if len(cameras) < 2:
        raise CalibrationError(
            f"{recording.path}: two cameras of the rig expected, {', '.join(cameras)} found; one clock alone has no offset. "
            "Record the board with another camera of the rig"
        )
    board = board_for(recording, rig)
    reference = rig.reference if rig.reference in cameras else cameras[0]
    own = {c: rig.cameras[c] for c in cameras}
    lenses = {c: camera.intrinsics for c, camera in own.items()}
    found = [v for v in detections.views if v.camera in cameras]
    on_plane = filter_planes(found, lenses, {}, config.plane_filter, config.seed)
    views = [_corrected(v, own[v.camera]) for v in on_plane.views]
    poses = {c: camera.T_world_color for c, camera in own.items()}
    start = start_of(recording, views, board, lenses, {}, reference, config, poses)
    priors = {
        c: CameraPrior(lenses[c], None, False, None, "all", depth_unit_m=recording.cameras[c].depth_step_m)
        for c in cameras
    }
    params = replace(config.bundle, hold=(*config.bundle.hold, *KNOWN))
    solved = estimate(start.views, (), board, priors, start.clocks, start.first_s, poses, reference, params)
    counts = {c: sum(v.placed.view.camera == c for v in start.views) for c in cameras}
    clocks = {c: clock_of(solved, c) for c in cameras}
    return Timing(reference, clocks, counts, start.left_out, solved.course.message, start.remarks)


def _corrected(view: BoardView, camera: RigCamera) -> BoardView:
    """The view with depth as the rig corrects it; without depth where that is of another geometry."""
    sensor, there = camera.depth_sensor, np.isfinite(view.depth_m)
    if not there.any():
        return view
    depth = np.full(len(view.depth_m), np.nan)
    depth[there] = sensor.correct(view.corners_px[there], view.depth_m[there])
    return replace(view, depth_m=depth)


@dataclass(frozen=True)
class NearestFrames:
    """Frames of the cameras nearest to one instant; (frame, t_s, depth_t_s) by camera."""

    t_s: float
    frames: dict[str, tuple[str, float, float]]


def nearest_sets(recording: Recording, clocks: Mapping[str, Clock], reference: str) -> list[NearestFrames]:
    """For each frame of the reference the nearest of each other camera, none farther than half a period; each used once.

    Raises
    ------
    ConfigError
        A camera has no stamps, or none is of the reference's.
    """
    table: dict[str, tuple[list[str], FloatArray, FloatArray]] = {}
    for c in recording.cameras:
        if c not in clocks:
            raise ConfigError(
                f"{recording.path}: a clock of each camera expected, none of {c} found. Run sync with this camera"
            )
        stamps, clock = stamps_s(recording, c)[0], clocks[c]
        values = np.array(list(stamps.values()))
        color, depth = (s + clock.offset_s + 1e-6 * clock.drift_ppm * (s - values[0, 0]) for s in values.T)
        table[c] = (list(stamps), color, depth + clock.depth_delay_s)
    frames, times, depths = table[reference]
    chosen: list[dict[str, tuple[str, float, float]]] = [
        {reference: (f, float(t), float(d))} for f, t, d in zip(frames, times, depths, strict=True)
    ]
    for c, (names, own, own_depth) in table.items():
        if c == reference:
            continue
        limit = 0.5 * max(float(np.median(np.diff(x))) if len(x) > 1 else np.inf for x in (own, times))
        nearest = np.abs(own[None] - times[:, None]).argmin(axis=1)
        taken: dict[int, int] = {}
        for k, j in enumerate(nearest):
            apart = abs(own[j] - times[k])
            if apart <= limit and (j not in taken or apart < abs(own[j] - times[taken[j]])):
                taken[int(j)] = k
        for j, k in taken.items():
            chosen[k][c] = (names[j], float(own[j]), float(own_depth[j]))
    sets = [NearestFrames(float(t), own) for t, own in zip(times, chosen, strict=True) if len(own) > 1]
    if not sets:
        raise ConfigError(
            f"{recording.path}: frames of two cameras within half a period expected, none found on the clocks given. Are they "
            "this recording's? Run sync on it"
        )
    return sets

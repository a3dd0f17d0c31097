"""`calibrate` on a recording of a carried board: the rig and the clocks of its cameras together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.recording import Recording
from rgbd_calib.pipeline import frame_selection
from rgbd_calib.pipeline.carried import CarriedStart, stamps_s, start_of
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.detection import Detections, Progress, board_of, silent
from rgbd_calib.pipeline.prepare import DepthSource, IntrinsicsSource, resolve_depth, resolve_intrinsics
from rgbd_calib.pipeline.workers import Workers
from rgbd_calib.quality import CarriedBoard
from rgbd_calib.rig.motion.estimate import clock_of, estimate, frame_name
from rgbd_calib.rig.observations import Walls
from rgbd_calib.rig.solution import Solution
from rgbd_calib.types import BoardView, Clock, PlacedView
from rgbd_calib.views.plane_filter import PlaneFilterResult, filter_planes

MAX_LENS_VIEWS = 60
"""Of each camera, spread over the recording, for the first intrinsics: the bundle uses all."""
EVERY_S = 0.5
"""Between the board poses that are kept."""


@dataclass(frozen=True)
class CarriedSolution:
    """The rig with its clocks, and what it started from."""

    solution: Solution
    start: CarriedStart
    lenses: IntrinsicsSource
    depth: DepthSource
    filtered: PlaneFilterResult
    clocks: dict[str, Clock]

    @property
    def placed(self) -> tuple[PlacedView, ...]:
        """The carried views, under their own frames' names."""
        return tuple(v.placed for v in self.start.views)

    def board_poses(self) -> dict[str, FloatArray]:
        """T_world_board (4, 4) of a view each half second, by `camera frame`."""
        every, last = self.solution.board_poses(), -EVERY_S
        out: dict[str, FloatArray] = {}
        for t, name in self._in_time():
            if t - last >= EVERY_S or not out:
                out[name], last = every[name], t
        return out

    def frames_in_time(self) -> tuple[str, ...]:
        """Names of the carried views' frames, by their estimated instants."""
        return tuple(name for _, name in self._in_time())

    def _in_time(self) -> list[tuple[float, str]]:
        offset_s = {c: own.start.offset_s for c, own in self.start.clocks.items()}
        offset_s |= {c: clock.offset_s for c, clock in self.clocks.items()}
        return sorted((v.color_s + offset_s[v.placed.view.camera], frame_name(v.placed)) for v in self.start.views)


def solve_carried(
    recording: Recording,
    config: Config,
    detections: Detections,
    reference: str,
    intrinsics: Path | None = None,
    depth_bias: Path | None = None,
    workers: Workers | None = None,
    progress: Progress = silent,
    intrinsic_detections: Detections | None = None,
) -> CarriedSolution:
    """Solve for rig, clocks and motion.

    Raises
    ------
    ConfigError
        A method or depth that needs frames of one instant, or no stamps.
    CalibrationError
        The clocks or the rig cannot be determined.
    """
    check_possible(recording, config)
    board, cameras = board_of(recording), list(recording.cameras)
    lenses = resolve_intrinsics(
        intrinsics, recording, _some(detections), config, workers, progress, intrinsic_detections
    )
    depth = resolve_depth(depth_bias, recording, lenses.intrinsics, config, workers, progress)
    filtered = filter_planes(detections.views, lenses.intrinsics, depth.biases, config.plane_filter, config.seed)
    start = start_of(recording, filtered.views, board, lenses.intrinsics, depth.biases, reference, config)
    priors = frame_selection.bundle_priors(lenses, depth, recording, config.bundle)
    poses = start.T_world_color
    alone = frame_selection.views_alone(lenses, depth.biases, recording, poses, board, config)
    walls = Walls.of(cameras, depth.walls)
    solved = estimate(
        start.views, alone, board, priors, start.clocks, start.first_s, poses, reference, config.bundle, walls
    )
    clocks = {c: clock_of(solved, c) for c in recording.color_cameras}
    return CarriedSolution(solved, start, lenses, depth, filtered, clocks)


def check_possible(recording: Recording, config: Config) -> None:
    """Refuse what needs frames of one instant.

    Raises
    ------
    ConfigError
        Another method than bundle, free structure, a selection of frames, or frames without timestamps.
    """
    where = f"{recording.path / 'dataset.yaml'}: synchronous is false"
    if config.method != "bundle" or config.bundle.structure == "free":
        asked = f"method {config.method}" if config.method != "bundle" else "free structure"
        raise ConfigError(
            f"{where}: method bundle with a rigid board expected, which estimates the clocks, {asked} found. Leave it out, or "
            "join frames by time with `rgbd-calib sync --apply`"
        )
    if config.max_views is not None:
        raise ConfigError(
            f"{where}: all views of the carried board expected, a selection of {config.max_views} found. Leave it out"
        )
    for camera in recording.cameras:
        stamps_s(recording, camera)


def _some(detections: Detections) -> Detections:
    """Some views of each camera, spread over its recording."""
    by_camera: dict[str, list[BoardView]] = {}
    for view in detections.views:
        by_camera.setdefault(view.camera, []).append(view)
    kept = [v for own in by_camera.values() for v in own[:: -(-len(own) // MAX_LENS_VIEWS)]]
    return replace(detections, views=tuple(kept))


def clock_quality(found: CarriedSolution, reference: str) -> CarriedBoard:
    """What a rig file says of the clocks beyond their values."""
    problem = found.solution.problem
    jerk = getattr(problem, "jerk", None)
    return CarriedBoard(
        views=len(found.start.views),
        left_out={f"{camera} {frame}": why for (camera, frame), why in sorted(found.start.left_out.items())},
        remarks=tuple(found.start.remarks),
        jerk_rad_per_s3=None if jerk is None else jerk[0],
        jerk_m_per_s3=None if jerk is None else jerk[1],
        reference=reference,
    )

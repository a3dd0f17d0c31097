"""What a calibration needs of each camera before the poses: intrinsics and depth biases, from files or recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rgbd_calib.cameras.depth_bias import DepthBiasFit, fit_with_data
from rgbd_calib.cameras.intrinsics import IntrinsicsResult, calibrate_intrinsics
from rgbd_calib.cameras.wall import SeenWall, depth_at, wall_cells
from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.recording import CameraInfo, Recording, open_recording
from rgbd_calib.io.rig import read_depth_bias, read_depth_bias_samples, read_intrinsics, read_intrinsics_sd
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.detection import Detections, Progress, board_of, detect, silent
from rgbd_calib.pipeline.workers import Workers
from rgbd_calib.types import BoardView, DepthBias
from rgbd_calib.views.board_pose import pose_view
from rgbd_calib.views.doctor import check_stems


@one_blas_thread
def intrinsics_of_views(
    recording: Recording, detections: Detections, config: Config, cameras: Sequence[str] | None = None
) -> dict[str, IntrinsicsResult]:
    """Intrinsics of each camera from its own views of the board.

    Raises
    ------
    CalibrationError
        A camera has too few views, or views that do not determine its focal length.
    """
    board = board_of(recording)
    out = {}
    for name in recording.cameras if cameras is None else cameras:
        info, views = recording.cameras[name], detections.of(name)
        if not views:
            raise CalibrationError(
                f"{name}: the board was found in none of its {len(recording.color_files[name])} images of {recording.path}, "
                f"{config.intrinsics.min_views} views needed for the intrinsics. Film the board close, or give --intrinsics FILE"
            )
        out[name] = calibrate_intrinsics(views, board, (info.width, info.height), config.intrinsics)
    return out


@dataclass(frozen=True)
class IntrinsicsSource:
    """Intrinsics by camera, where they are from, and the views that they rest on (none from a file)."""

    intrinsics: dict[str, Intrinsics]
    origin: str
    results: dict[str, IntrinsicsResult]
    views: tuple[BoardView, ...]
    """Of an intrinsic recording; the calibrated recording's own views are not listed again."""
    standard_deviations: dict[str, np.ndarray]
    """(9,) by camera, where a file has them."""


def check_together(recording: Recording) -> None:
    """Refuse a recording whose frames do not say what was simultaneous.

    Raises
    ------
    CalibrationError
        A camera shares no frame name with any other, or dataset.yaml says that equal names are not one instant.
    """
    if not recording.synchronous:
        raise CalibrationError(
            f"{recording.path / 'dataset.yaml'}: synchronous is false, and frames of one instant are needed. Join frames by "
            "time with `rgbd-calib import RECORDING -o NEW --match timestamp`"
        )
    color = {c: tuple(files) for c, files in recording.color_files.items()}
    for apart in check_stems(color, {c: recording.timestamps_us(c) for c in recording.cameras}):
        raise CalibrationError(f"{recording.path}: {apart.sentence}")


def check_sources(recording: Recording, intrinsics: Path | None, depth_bias: Path | None) -> None:
    """Open what intrinsics and depth biases shall come from, before the long work.

    Raises
    ------
    ConfigError
        Not there, not readable, lacks a camera of the recording, or is of another image size.
    """
    for source, what in ((intrinsics, "intrinsics"), (depth_bias, "depth_bias")):
        if source is not None and source.is_dir():
            other = open_recording(source)
            cameras = [name for name in recording.cameras if what == "intrinsics" or recording.depth_files[name]]
            _need(source, "images", cameras, other.cameras)
            for name in cameras:
                _check_size(source, name, other.cameras[name], recording)
    if intrinsics is not None and not intrinsics.is_dir():
        given = read_intrinsics(intrinsics)
        _need(intrinsics, "intrinsics", list(recording.cameras), given)
        for name in recording.cameras:
            _check_size(intrinsics, name, given[name], recording)
    if depth_bias is not None and not depth_bias.is_dir():
        cameras = [name for name in recording.cameras if recording.depth_files[name]]
        _need(depth_bias, "depth_bias", cameras, read_depth_bias(depth_bias))


def resolve_intrinsics(
    source: Path | None,
    recording: Recording,
    detections: Detections,
    config: Config,
    workers: Workers | None = None,
    progress: Progress = silent,
    source_detections: Detections | None = None,
) -> IntrinsicsSource:
    """Intrinsics from a file or an intrinsic recording; else from dataset.yaml; else from the recording's own views.

    `source_detections` are the corners of an intrinsic recording, where they were found before.
    """
    cameras = list(recording.cameras)
    check_sources(recording, source, None)
    if source is not None and source.is_dir():
        other = open_recording(source)
        found = source_detections or detect(other, config.detect, workers, progress)
        results = intrinsics_of_views(other, found, config, cameras)
        given = {name: result.intrinsics for name, result in results.items()}
        return IntrinsicsSource(given, str(source), results, found.views, {})
    if source is not None:
        given = read_intrinsics(source)
        return IntrinsicsSource(
            {name: given[name] for name in cameras}, str(source), {}, (), read_intrinsics_sd(source)
        )
    in_dataset = {name: info.intrinsics for name, info in recording.cameras.items() if info.intrinsics is not None}
    own = [name for name in cameras if name not in in_dataset]
    results = intrinsics_of_views(recording, detections, config, own) if own else {}
    given = in_dataset | {name: result.intrinsics for name, result in results.items()}
    origin = "dataset.yaml" if not own else "the recording's own views" + (" and dataset.yaml" if in_dataset else "")
    return IntrinsicsSource({name: given[name] for name in cameras}, origin, results, (), {})


def given_intrinsics(source: Path, cameras: Sequence[str]) -> IntrinsicsSource:
    """Intrinsics of these cameras from a file."""
    given = read_intrinsics(source)
    _need(source, "intrinsics", cameras, given)
    return IntrinsicsSource({name: given[name] for name in cameras}, str(source), {}, (), read_intrinsics_sd(source))


@dataclass(frozen=True)
class DepthSource:
    """What is known of the cameras' depth before the rig, and where it is from."""

    biases: dict[str, DepthBias]
    origin: str
    samples: dict[str, Any]
    """By camera, the data that the depth bias was fitted to, where they are known."""
    walls: dict[str, tuple[SeenWall, ...]]
    """By camera, the walls that the depth bias rests on; none where it is from a file or from boards."""


NO_DEPTH_SOURCE = DepthSource({}, "none", {}, {})


def walls_of_recording(
    recording: Recording, name: str, config: Config, progress: Progress = silent
) -> tuple[SeenWall, ...]:
    """Walls of a bias recording as one camera sees them; none without distances.csv.

    Raises
    ------
    ConfigError
        A frame without depth image.
    """
    distances, out = recording.distances_m(name), []
    for frame in progress(sorted(distances), len(distances), f"{name}: wall"):
        if not recording.has_depth(name, frame):
            raise ConfigError(
                f"{recording.path / name / 'distances.csv'}: frame {frame} has no depth image. Record it, or remove the line"
            )
        distance_m, sd_m = distances[frame]
        cells = wall_cells(recording.depth_m(name, frame))
        if cells.seen.any():
            out.append(SeenWall(frame, distance_m, sd_m or config.depth_bias.distance_sd_m, cells))
    return tuple(out)


@one_blas_thread
def depth_of_recording(
    recording: Recording,
    intrinsics: Mapping[str, Intrinsics],
    config: Config,
    detections: Detections | None = None,
    workers: Workers | None = None,
    progress: Progress = silent,
) -> tuple[dict[str, DepthBiasFit], dict[str, tuple[SeenWall, ...]]]:
    """Depth bias of each camera that has depth: from distances.csv, else from the board's pose by pixels; and the walls.

    Raises
    ------
    CalibrationError
        Too few distances, over too short a range, or neither distances nor intrinsics.
    """
    fits, walls = {}, {}
    for name in recording.cameras:
        if not recording.depth_files[name]:
            continue
        if recording.distances_m(name):
            walls[name] = walls_of_recording(recording, name, config, progress)
            z_m, z_true_m, sigma_m = _wall_samples(walls[name], recording.cameras[name], intrinsics.get(name))
        else:
            if name not in intrinsics:
                raise ConfigError(
                    f"{recording.path}: {name} has no distances.csv, so that the true depth must come from the board's pose, "
                    "and for this the camera's intrinsics are needed. Give --intrinsics, or write distances.csv"
                )
            detections = detections or detect(recording, config.detect, workers, progress)
            (z_m, z_true_m), sigma_m = _board_pairs(detections.of(name), recording, intrinsics[name]), None
        fits[name] = fit_with_data(z_m, z_true_m, config.depth_bias, camera=name, sigma_m=sigma_m)
    if not fits:
        raise CalibrationError(f"{recording.path}: no camera has depth images; nothing to correct. Record depth too")
    return fits, walls


def resolve_depth(
    source: Path | None,
    recording: Recording,
    intrinsics: Mapping[str, Intrinsics],
    config: Config,
    workers: Workers | None,
    progress: Progress,
) -> DepthSource:
    """What is known of the depth, from a file or a bias recording."""
    if source is None:
        return NO_DEPTH_SOURCE
    check_sources(recording, None, source)
    cameras = [name for name in recording.cameras if recording.depth_files[name]]
    walls: dict[str, tuple[SeenWall, ...]] = {}
    if source.is_dir():
        fits, walls = depth_of_recording(open_recording(source), intrinsics, config, workers=workers, progress=progress)
        given = {name: fit.bias for name, fit in fits.items()}
        samples = {name: samples_of(fit) for name, fit in fits.items()}
    else:
        given, samples = read_depth_bias(source), read_depth_bias_samples(source)
    _need(source, "depth_bias", cameras, given)  # one without depth images in a bias recording has none
    mine = {name: walls[name] for name in cameras if name in walls}
    return DepthSource({name: given[name] for name in cameras}, str(source), samples, mine)


def samples_of(fit: DepthBiasFit) -> dict[str, Any]:
    """The data behind a depth bias, for a file."""
    return {"z_m": fit.z_m, "z_true_m": fit.z_true_m, "dropped": fit.dropped}


def _wall_samples(
    walls: Sequence[SeenWall], info: CameraInfo, intrinsics: Intrinsics | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depths at the principal point, true distances and standard errors of their differences, (n,) each, metres."""
    centre = (intrinsics.cx, intrinsics.cy) if intrinsics else ((info.width - 1) / 2, (info.height - 1) / 2)
    rows = [(*depth_at(wall.cells, centre), wall.distance_m, wall.sd_m) for wall in walls]
    table = np.array([row for row in rows if np.isfinite(row[0])]).reshape(-1, 4)
    z_m, error_m, z_true_m, sd_m = table.T
    rounding_m = info.depth_scale / np.sqrt(12)  # of the depth image, the same for all pixels of a square wall
    return z_m, z_true_m, np.sqrt(error_m**2 + rounding_m**2 + sd_m**2)


def _board_pairs(
    views: Sequence[BoardView], recording: Recording, intrinsics: Intrinsics
) -> tuple[np.ndarray, np.ndarray]:
    """One pair a view: corners of one view share the error of its pose."""
    board = board_of(recording)
    pairs = []
    for view in views:
        measured = np.isfinite(view.depth_m)
        if measured.sum() >= board.n_corners // 2:
            posed = pose_view(view, board, intrinsics, None)
            z = se3.transform(posed.T_color_face, board.corners_m()[view.ids])[:, 2]
            pairs.append((1 / np.median(1 / view.depth_m[measured]), 1 / np.median(1 / z[measured])))
    table = np.array(pairs).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def _need(source: Path, what: str, cameras: Sequence[str], given: Mapping[str, Any]) -> None:
    missing = [name for name in cameras if name not in given]
    if missing:
        raise ConfigError(
            f"{source}: no {what} of {', '.join(missing)}; seen: {', '.join(given)}; every camera of the recording is needed. "
            "Add it, or take the camera out of dataset.yaml"
        )


def _check_size(source: Path, name: str, other: Intrinsics | CameraInfo, recording: Recording) -> None:
    info = recording.cameras[name]
    if (other.width, other.height) != (info.width, info.height):
        raise ConfigError(
            f"{source}: {name}: for images of {other.width}x{other.height} px, the recording has "
            f"{info.width}x{info.height}; the same size is needed. Calibrate the camera at this size"
        )

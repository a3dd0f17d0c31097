"""What a calibration needs of each camera before the poses: intrinsics and depth biases, from files or recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from rgbd_calib.cameras.depth_bias import DepthBiasFit, fit_with_data
from rgbd_calib.cameras.intrinsics import IntrinsicsResult, calibrate_intrinsics
from rgbd_calib.cameras.wall import SeenWall, depth_at, wall_cells
from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.dataset import scaled
from rgbd_calib.io.recording import CameraInfo, Recording, open_recording
from rgbd_calib.io.rig import read_depth_bias, read_depth_bias_samples, read_intrinsics, read_intrinsics_sd
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.depth_cameras import split
from rgbd_calib.pipeline.detection import Detections, Progress, board_of, detect, silent
from rgbd_calib.pipeline.workers import Workers
from rgbd_calib.quality import BiasSamples
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
            "time with `rgbd-calib sync RECORDING --apply TIMING -o NEW`, or, where the clocks agree, with `rgbd-calib import "
            "RECORDING -o NEW --match timestamp`"
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
    color = recording.color_cameras
    for source, what in ((intrinsics, "intrinsics"), (depth_bias, "depth_bias")):
        if source is not None and source.is_dir():
            other = split(open_recording(source))
            cameras = color if what == "intrinsics" else recording.cameras_with_depth
            _need(source, "images", cameras, other.cameras)
            for name in cameras:
                _check_size(source, name, other.cameras[name], recording)
    if intrinsics is not None and not intrinsics.is_dir():
        given = read_intrinsics(intrinsics)
        _need(intrinsics, "intrinsics", color, given)
        for name in color:
            _check_size(intrinsics, name, given[name], recording)
    if depth_bias is not None and not depth_bias.is_dir():
        cameras = recording.cameras_with_depth
        _need(depth_bias, "depth_bias", cameras, _by_depth_camera(read_depth_bias(depth_bias), recording))


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
    cameras = recording.color_cameras
    check_sources(recording, source, None)
    if source is not None and source.is_dir():
        other = split(open_recording(source))
        found = source_detections or detect(other, config.detect, workers, progress)
        results = intrinsics_of_views(other, found, config, cameras)
        given = {name: result.intrinsics for name, result in results.items()}
        given, results, sds = _with_depth_cameras(given, results, recording, (detections, found), config)
        return IntrinsicsSource(given, str(source), results, found.views, sds)
    if source is not None:
        in_file = read_intrinsics(source)
        given = {name: in_file[name] for name in cameras}
        given, results, sds = _with_depth_cameras(given, {}, recording, (detections,), config)
        return IntrinsicsSource(given, str(source), results, (), read_intrinsics_sd(source) | sds)
    in_dataset = {name: lens for name in cameras if (lens := recording.cameras[name].intrinsics) is not None}
    own = [name for name in cameras if name not in in_dataset]
    results = intrinsics_of_views(recording, detections, config, own) if own else {}
    given = in_dataset | {name: result.intrinsics for name, result in results.items()}
    origin = "dataset.yaml" if not own else "the recording's own views" + (" and dataset.yaml" if in_dataset else "")
    given = {name: given[name] for name in cameras}
    given, results, sds = _with_depth_cameras(given, results, recording, (detections,), config)
    return IntrinsicsSource(given, origin, results, (), sds)


def _with_depth_cameras(
    given: Mapping[str, Intrinsics],
    results: Mapping[str, IntrinsicsResult],
    recording: Recording,
    sources: Sequence[Detections],
    config: Config,
) -> tuple[dict[str, Intrinsics], dict[str, IntrinsicsResult], dict[str, np.ndarray]]:
    """The same with the depth cameras of a split recording: lenses, what they rest on, and standard deviations.

    A lens is taken as it was stated where its deviations were stated too, or where there are no views of the board in infrared
    images; else it is estimated from these.

    Raises
    ------
    ConfigError
        Neither is there.
    """
    lenses, found, sds = dict(given), dict(results), dict[str, np.ndarray]()
    for name, info in recording.cameras.items():
        if info.mount is None:
            continue
        own, color = info.intrinsics, given[info.mount.camera]
        views = max((source.of(name) for source in sources), key=len)
        T = info.mount.T_color_depth
        if own is not None and info.mount.intrinsics_sd is not None:
            lenses[name], sds[name] = own, np.array(info.mount.intrinsics_sd)
        elif len(views) >= config.intrinsics.min_views:
            found[name] = calibrate_intrinsics(views, board_of(recording), (info.width, info.height), config.intrinsics)
            lenses[name] = found[name].intrinsics
        elif own is not None:
            lenses[name] = own
        elif T is not None and np.allclose(T, np.eye(4), atol=1e-9):  # of another size, in the colour camera's place
            lenses[name] = scaled(color, info.width, info.height)
        else:
            raise ConfigError(
                f"{recording.path}: depth of {info.mount.camera} has a geometry of its own, of which too little is known: no "
                f"intrinsics in its depth block, and the board in {len(views)} infrared images. Write its factory's intrinsics "
                "and T_color_depth into dataset.yaml (`rgbd-calib init` finds them), record infrared images "
                f"({config.intrinsics.min_views} of the board), or register depth to colour with the sensor's own software"
            )
        if T is None and not recording.color_files[name]:
            raise ConfigError(
                f"{recording.path / 'dataset.yaml'}: {info.mount.camera}: T_color_depth is missing in its depth block, and there "
                "are no infrared images to find it. Write it as it is meant to be, to a centimetre, or record infrared images"
            )
    return {name: lenses[name] for name in recording.cameras}, found, sds


def given_intrinsics(source: Path, cameras: Sequence[str]) -> IntrinsicsSource:
    """Intrinsics of these cameras from a file."""
    given = read_intrinsics(source)
    _need(source, "intrinsics", cameras, given)
    return IntrinsicsSource({name: given[name] for name in cameras}, str(source), {}, (), read_intrinsics_sd(source))


T = TypeVar("T")


@dataclass(frozen=True)
class DepthSource:
    """What is known of the cameras' depth before the rig, and where it is from."""

    biases: dict[str, DepthBias]
    origin: str
    samples: dict[str, BiasSamples]
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
    mount = recording.cameras[name].mount
    T = np.eye(4) if mount is None or mount.T_color_depth is None else mount.T_color_depth
    normal = T[2, :3]  # of a wall square to the colour camera, in the depth camera's frame
    tilt = float(-normal[0] / normal[2]), float(-normal[1] / normal[2])
    for frame in progress(sorted(distances), len(distances), f"{name}: wall"):
        if not recording.has_depth(name, frame):
            raise ConfigError(
                f"{recording.path / name / 'distances.csv'}: frame {frame} has no depth image. Record it, or remove the line"
            )
        distance_m, sd_m = distances[frame]
        cells = wall_cells(recording.depth_m(name, frame))
        if cells.seen.any():
            sd_m = sd_m or config.depth_bias.distance_sd_m
            out.append(SeenWall(frame, float((distance_m - T[2, 3]) / normal[2]), sd_m, cells, tilt))
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
    cameras = recording.cameras_with_depth
    walls: dict[str, tuple[SeenWall, ...]] = {}
    if source.is_dir():
        other = split(open_recording(source))
        fits, walls = depth_of_recording(other, intrinsics, config, workers=workers, progress=progress)
        given = {name: fit.bias for name, fit in fits.items()}
        samples = {name: samples_of(fit) for name, fit in fits.items()}
    else:
        given = _by_depth_camera(read_depth_bias(source), recording)
        samples = _by_depth_camera(read_depth_bias_samples(source), recording)
    _need(source, "depth_bias", cameras, given)  # one without depth images in a bias recording has none
    mine = {name: walls[name] for name in cameras if name in walls}
    return DepthSource({name: given[name] for name in cameras}, str(source), samples, mine)


def _by_depth_camera(by_camera: Mapping[str, T], recording: Recording) -> dict[str, T]:
    """What a file says of cameras, by the depth cameras of a split recording."""
    parent = {name: info.mount.camera for name, info in recording.cameras.items() if info.mount is not None}
    moved = {name: by_camera[camera] for name, camera in parent.items() if camera in by_camera}
    return {name: value for name, value in by_camera.items() if name not in parent.values()} | moved


def samples_of(fit: DepthBiasFit) -> BiasSamples:
    """The data behind a depth bias, for a file."""
    return BiasSamples(fit.z_m, fit.z_true_m, tuple(fit.dropped.tolist()))


def _wall_samples(
    walls: Sequence[SeenWall], info: CameraInfo, intrinsics: Intrinsics | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depths at the principal point, true distances and standard errors of their differences, (n,) each, metres."""
    centre = (intrinsics.cx, intrinsics.cy) if intrinsics else ((info.width - 1) / 2, (info.height - 1) / 2)
    rows = [(*depth_at(wall.cells, centre), wall.distance_m, wall.sd_m) for wall in walls]
    table = np.array([row for row in rows if np.isfinite(row[0])]).reshape(-1, 4)
    z_m, error_m, z_true_m, sd_m = table.T
    rounding_m = info.depth_step_m / np.sqrt(12)  # of the depth image, the same for all pixels of a square wall
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


def _need(source: Path, what: str, cameras: Sequence[str], given: Mapping[str, object]) -> None:
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

"""A dataset.yaml for a folder of images that nobody described: what is in it, and what the images say of board and depth."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from rgbd_calib.cameras.intrinsics import calibrate_intrinsics
from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.board_files import read_board
from rgbd_calib.io.calibrations import FoundCalibration, FoundCamera, read_calibration
from rgbd_calib.io.dataset import CameraInfo, DepthGeometry
from rgbd_calib.io.depth_files import FARTHEST_M, NO_MEASUREMENT, read_depth_raw
from rgbd_calib.io.folder_guess import Guess, Stream, guess_layout, names_coincide
from rgbd_calib.io.frame_names import spelled_anew, times_us
from rgbd_calib.io.images import as_bgr, read_image
from rgbd_calib.io.layout import Kind, describe_unused, walk
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.detection import Progress, silent
from rgbd_calib.types import Board, BoardView, DepthCamera
from rgbd_calib.views.board_guess import BoardGuess, guess_board
from rgbd_calib.views.coverage import nominal_intrinsics
from rgbd_calib.views.depth_evidence import DepthUnit, find_depth_unit
from rgbd_calib.views.detect import detect_view

_CALIBRATION_SUFFIXES = (".yaml", ".yml", ".json", ".xml", ".toml", ".cameramodel")
_BOARD_SUFFIXES = (".yaml", ".yml")
_MAX_CALIBRATION_FILES = 200
_IMAGES_FOR_BOARD = 12
_VIEWS_FOR_UNIT = 12
"""Of each camera: 8 views estimate a lens."""
_MIN_VIEWS_FOR_LENS = 8
_FOLLOWS = 1.3
"""Units for each metre by two images differ by less, whatever the unit: a guessed lens errs in all of them alike."""
_IMPORTED_DEPTH = (".npz", ".exr")
_UNREAD_DEPTH = (*_IMPORTED_DEPTH, ".raw", ".bin", ".dat", ".mat", ".pfm", ".hdf5", ".h5")


@dataclass(frozen=True)
class FolderContents:
    """What a folder holds."""

    folder: Path
    guess: Guess
    calibrations: tuple[tuple[Path, FoundCalibration], ...] = ()
    boards: tuple[tuple[Path, Board], ...] = ()
    """Of files that describe nothing but a board."""

    @property
    def together(self) -> int:
        """Frames that two cameras or more have."""
        frames = [frame for stream in self.guess.streams["color"].values() for frame in stream.files]
        return sum(n > 1 for n in Counter(frames).values())

    def float_depth(self, camera: str) -> bool:
        stream = self.guess.streams["depth"].get(camera)
        return stream is not None and stream.sniffed.pixels == "float"


@dataclass(frozen=True)
class Answers:
    """What nobody but the user knows."""

    board: Board | None = None
    depth_scale: float | None = None
    """Metres for each unit of all depth; None: not said."""
    registered: bool | None = None
    """None: depth of colour's size is registered, other depth is not."""


@dataclass(frozen=True)
class Described:
    """The cameras of a folder, and how their depth's unit is known."""

    cameras: dict[str, CameraInfo]
    unknown_unit: dict[str, str]
    """Why the unit of a camera's depth is not known, by camera."""
    remarks: tuple[str, ...] = field(default=())


def look_at(folder: Path, given: Mapping[Kind, str] | None = None, calibration: Path | None = None) -> FolderContents:
    """What is in a folder, by the names and headers of its files.

    Raises
    ------
    ConfigError
        No such folder, no colour images, or names that do not tell which camera is which.
    """
    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder. Give the folder that holds the images")
    guess = guess_layout(folder, given)
    boards = tuple(_boards(folder))
    if calibration is not None:
        return FolderContents(folder, guess, ((calibration, read_calibration(calibration)),), boards)
    return FolderContents(folder, guess, tuple(_calibrations(folder)), boards)


def check_frames(found: FolderContents) -> None:
    """Refuse a folder whose files cannot make frames where they are.

    Raises
    ------
    ConfigError
        Depth in files that only an import reads, or names of files that are times and differ.
    """
    folder, guess = found.folder, found.guess
    new = f"rgbd-calib import {shlex.quote(str(folder))} -o RECORDING"
    streams = [s for of_kind in guess.streams.values() for s in of_kind.values()]
    if spelled_anew(frame for s in streams for frame in s.files):
        seen = "; ".join(f"{s.template}: {_names(s)}" for s in streams[:4])
        raise ConfigError(
            f"{folder}: one name for images of one instant expected, numbers written in several ways seen ({seen}). Join them: {new}"
        )
    if not guess.streams["depth"]:
        unread = [p for p in walk(folder) if Path(p).suffix.lower() in _UNREAD_DEPTH and "depth" in p.lower()]
        if not unread:
            return
        seen = describe_unused(unread)
        if Path(unread[0]).suffix.lower() in _IMPORTED_DEPTH:
            raise ConfigError(
                f"{folder}: depth in files that are read where they are expected, {seen} seen. Import: {new}"
            )
        raise ConfigError(
            f"{folder}: depth images expected, {seen} seen: such files state neither size nor type. Write depth as 16-bit PNG or .npy"
        )
    for camera, depth in guess.streams["depth"].items():
        color = guess.streams["color"][camera]
        if not set(color.files) & set(depth.files):
            match = "order" if times_us([*color.files, *depth.files]) is None else "timestamp"
            raise ConfigError(
                f"{folder}: {camera}: names of depth images that are those of colour images expected, {_names(color)} and "
                f"{_names(depth)} seen. Join them by {'time' if match == 'timestamp' else 'order'}: {new} --match {match}"
            )

    if not names_coincide(guess) and times_us([frame for s in streams for frame in s.files]) is not None:
        seen = "; ".join(f"{name}: {_names(stream)}" for name, stream in list(guess.streams["color"].items())[:3])
        raise ConfigError(
            f"{folder}: equal names for images of one instant expected, times that differ seen ({seen}). Join them by time: {new} --match "
            "timestamp"
        )


def _names(stream: Stream) -> str:
    return ", ".join(list(stream.files)[:2])


def find_board(found: FolderContents, progress: Progress = silent) -> BoardGuess | None:
    """The checkerboard that is seen in some images of the folder."""
    streams = list(found.guess.streams["color"].values())
    each = -(-_IMAGES_FOR_BOARD // len(streams))
    paths = [found.folder / s.files[f] for s in streams for f in _some(list(s.files), each)]
    return guess_board(_color(path) for path in progress(paths, len(paths), "Looking for a board"))


def describe(found: FolderContents, answers: Answers, config: Config, progress: Progress = silent) -> Described:
    """The cameras as dataset.yaml has them; the unit of depth is concluded from the board where it is not said.

    Raises
    ------
    ConfigError
        Sizes of images that contradict each other, or an image that cannot be read.
    """
    cameras: dict[str, CameraInfo] = {}
    unknown: dict[str, str] = {}
    remarks: list[str] = []
    for name, stream in found.guess.streams["color"].items():
        size = (stream.sniffed.width, stream.sniffed.height)
        origin, known = _calibration_of(found, name, size)
        info = CameraInfo(*size, intrinsics=known.intrinsics)
        if origin and known.intrinsics:
            remarks.append(f"{name}: lens of {origin}")
        depth = found.guess.streams["depth"].get(name)
        if depth is not None:
            info = _with_geometry(info, depth, known, answers.registered)
            own = info.depth
            lacks = own is not None and own.intrinsics is None and own.T_color_depth is None
            if lacks and name not in found.guess.streams["ir"]:
                remarks.append(
                    f"{name}: depth is not registered, and no infrared images and no calibration of it were found: calibrate "
                    "needs one of them (--calibration FILE). If depth lies on colour at another resolution: --registered"
                )
            info, remark = with_unit(found, name, info, answers, config, progress)
            if info.depth_stated:
                remarks.append(remark)
            else:
                unknown[name] = remark
        cameras[name] = info
    return Described(cameras, unknown, tuple(remarks))


def sentences(found: FolderContents) -> list[str]:
    """What was found, for people."""
    lines = []
    kinds: tuple[tuple[Kind, str], ...] = (("depth", "depth"), ("ir", "infrared"))
    for name, stream in found.guess.streams["color"].items():
        parts = [f"{len(stream.files)} colour images {_looks(stream)}"]
        for kind, word in kinds:
            own = found.guess.streams[kind].get(name)
            if own is not None:
                without = len(set(stream.files) - set(own.files))
                lacking = f", {without} colour images without one" if without else ""
                parts.append(f"{len(own.files)} {word} images {_looks(own)}{lacking}")
        lines.append(f"{name}: {'; '.join(parts)}")
    if len(found.guess.cameras) > 1:
        lines.append(f"{found.together} frames are in two cameras or more")
    lines += [f"{path}: {own.what}, of {', '.join(own.cameras)}" for path, own in found.calibrations]
    return [*lines, *found.guess.remarks]


def _looks(stream: Stream) -> str:
    own = stream.sniffed
    words = {"color": "", "grey 8": ", grey", "grey 16": ", 16 bits", "float": ", floating point"}
    return f"{own.width}x{own.height}{words[own.pixels]} ({stream.template})"


def _boards(folder: Path) -> list[tuple[Path, Board]]:
    found = []
    paths = [
        folder / name for name in walk(folder) if name.endswith(_BOARD_SUFFIXES) and not name.endswith("dataset.yaml")
    ]
    for path in paths[:_MAX_CALIBRATION_FILES]:
        try:
            found.append((path, read_board(path)))
        except ConfigError:
            continue  # another file
    return found


def _calibrations(folder: Path) -> list[tuple[Path, FoundCalibration]]:
    found, tried = [], 0
    for relative in walk(folder):
        path = folder / relative
        if path.suffix.lower() not in _CALIBRATION_SUFFIXES or path.name == "dataset.yaml":
            continue
        tried += 1
        if tried > _MAX_CALIBRATION_FILES:
            break
        try:
            found.append((path, read_calibration(path)))
        except ConfigError:
            continue  # another file, or one that needs the size of the images
    return found


def _calibration_of(found: FolderContents, name: str, size: tuple[int, int]) -> tuple[str, FoundCamera]:
    """Where the camera's lens is known from, and what is known: by its name, or the only one of a folder's only camera."""
    alone = len(found.guess.cameras) == 1
    for path, calibration in found.calibrations:
        for own_name, own in calibration.cameras.items():
            same = own_name.casefold() == name.casefold() or (alone and len(calibration.cameras) == 1)
            lens = own.intrinsics
            if same and lens is not None and (lens.width, lens.height) == size:
                return str(path), own
    return "", FoundCamera()


def _with_geometry(info: CameraInfo, depth: Stream, known: FoundCamera, registered: bool | None) -> CameraInfo:
    size = (depth.sniffed.width, depth.sniffed.height)
    same = size == (info.width, info.height)
    if registered is None:
        registered = same
    if registered and same:
        return info
    if registered:  # the same view at another size
        return replace(info, depth=DepthGeometry(*size, T_color_depth=np.eye(4)))
    own = known.depth
    if own is not None and (own.intrinsics.width, own.intrinsics.height) == size:
        return replace(info, depth=DepthGeometry(*size, own.intrinsics, None, own.T_color_depth))
    return replace(info, depth=DepthGeometry(*size))


def with_unit(
    found: FolderContents, name: str, info: CameraInfo, answers: Answers, config: Config, progress: Progress
) -> tuple[CameraInfo, str]:
    """The camera with the unit of its depth stated, and how that is known; or as it was, and why it is not."""
    floating = found.float_depth(name)
    if answers.depth_scale is not None:
        scale = answers.depth_scale
        own = replace(info, float_unit_m=scale if floating else info.float_unit_m, depth_scale=scale)
        return replace(own, depth_stated=True), f"{name}: {scale:g} m for each unit of depth, as said"
    if floating:
        usual = _usual_depth(found, name)
        unit_m = 1.0 if usual <= FARTHEST_M else 0.001
        word = "metres" if unit_m == 1.0 else "millimetres"
        return replace(info, float_unit_m=unit_m, depth_scale=unit_m, depth_stated=True), (
            f"{name}: floating-point depth in {word} (median {usual:.4g})"
        )
    if answers.board is None:
        return info, f"{name}: there is no board to tell it by"
    told = _unit_by_board(found, name, info, answers.board, config, progress)
    if told.raw_per_m is None:
        return info, f"{name}: no image shows the board with depth on it"
    least, most = told.spread
    if info.depth is None and most > _FOLLOWS * least:
        return info, (
            f"{name}: depth does not follow the board: by its pixels a metre has {least:.0f} units in one image and {most:.0f} in "
            "another. Depth images of other frames than colour's, mirrored or rotated against colour, or disparity in place of "
            "depth: look at a pair"
        )
    if told.unit_m is None:
        mm = 1000 * answers.board.square_m
        return info, (
            f"{name}: by the board's pixels a metre has {told.raw_per_m:.0f} units, which none in use has (0.001 m would need "
            f"squares of {mm * told.raw_per_m / 1000:.1f} mm, {mm:g} mm stated)"
        )
    remark = f"{name}: {told.unit_m:g} m for each unit of depth, by the board's size in {told.views} images"
    if told.unit_m != 0.001:  # a mistyped square has the same effect
        mm = answers.board.square_m / told.unit_m
        remark += f" (if depth is in millimetres, the squares would be {mm:g} mm: check --square)"
    return replace(info, depth_scale=told.unit_m, depth_stated=True), remark


def _usual_depth(found: FolderContents, name: str) -> float:
    stream = found.guess.streams["depth"][name]
    medians = []
    for frame in _some(list(stream.files), 5):
        image = _depth(found.folder / stream.files[frame], stream)
        if np.isfinite(image).any():
            medians.append(float(np.nanmedian(image)))
    return float(np.median(medians)) if medians else 0.0


def _unit_by_board(
    found: FolderContents, name: str, info: CameraInfo, board: Board, config: Config, progress: Progress
) -> DepthUnit:
    color, depth = found.guess.streams["color"][name], found.guess.streams["depth"][name]
    frames = _some([f for f in color.files if f in depth.files], _VIEWS_FOR_UNIT)
    views: list[BoardView] = []
    for frame in progress(frames, len(frames), f"{name}: the board against depth"):
        view = detect_view(name, frame, _color(found.folder / color.files[frame]), None, board, config.detect)
        if view is not None:
            views.append(view)
    lens, known = _lens(info, views, board, config)
    camera: DepthCamera | None = None if info.depth is None else info.depth.camera(lens)
    raw = [_depth(found.folder / depth.files[view.frame], depth) for view in views]
    return find_depth_unit(views, raw, board, lens, known, info.depth is None, camera)


def _lens(info: CameraInfo, views: Sequence[BoardView], board: Board, config: Config) -> tuple[Intrinsics, bool]:
    if info.intrinsics is not None:
        return info.intrinsics, True
    size = (info.width, info.height)
    if len(views) >= _MIN_VIEWS_FOR_LENS:
        try:
            return calibrate_intrinsics(views, board, size, config.intrinsics).intrinsics, True
        except CalibrationError:
            pass  # views that do not determine it
    return nominal_intrinsics(size), False


def _some(frames: list[str], most: int) -> list[str]:
    """Frames spread over all of them."""
    if not frames:
        return []
    return [frames[i] for i in sorted({round(v) for v in np.linspace(0, len(frames) - 1, min(most, len(frames)))})]


def _color(path: Path) -> np.ndarray:
    return as_bgr(read_image(path).astype(np.uint8))


def _depth(path: Path, stream: Stream) -> np.ndarray:
    """A depth image (h, w) as stored, NaN where there is none."""
    raw = read_depth_raw(path, (stream.sniffed.width, stream.sniffed.height), "other depth images have")
    values = raw.astype(float)
    values[(values <= 0) | (values == NO_MEASUREMENT) | ~np.isfinite(values)] = np.nan
    return values

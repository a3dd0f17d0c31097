"""Recordings: a folder with dataset.yaml and, for each camera, colour and depth images (see the README)."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.files import dump_yaml, load_yaml, read_bytes, write_text
from rgbd_calib.io.images import MAX_BYTES, as_bgr, read_image, write_image
from rgbd_calib.io.schema_base import parse
from rgbd_calib.io.schema_parts import BoardModel, IntrinsicsModel
from rgbd_calib.io.schemas import DatasetModel
from rgbd_calib.io.tables import number, number_or_nan, read_table, short
from rgbd_calib.io.tables import write_table as write_table
from rgbd_calib.types import Board

T = TypeVar("T")
SUFFIXES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class CameraInfo:
    """What dataset.yaml says of a camera; `depth_scale` is metres for each unit of its depth images."""

    width: int
    height: int
    depth_scale: float = 0.001
    serial: str | None = None
    intrinsics: Intrinsics | None = None


@dataclass(frozen=True)
class Recording:
    """A recording on disk; images are read when they are asked for."""

    path: Path
    cameras: dict[str, CameraInfo]
    board: Board | None
    extra: dict[str, Any]
    """Keys of dataset.yaml that this program gives no meaning to."""

    @cached_property
    def color_files(self) -> dict[str, dict[str, Path]]:
        """Colour files by camera and frame, frames in order."""
        return {camera: _images(self.path / camera / "color", SUFFIXES) for camera in self.cameras}

    @cached_property
    def depth_files(self) -> dict[str, dict[str, Path]]:
        """Depth files by camera and frame."""
        return {camera: _images(self.path / camera / "depth", (".png",)) for camera in self.cameras}

    @property
    def frames(self) -> tuple[str, ...]:
        """Stems of all frames of all cameras, in order."""
        return tuple(sorted({frame for files in self.color_files.values() for frame in files}))

    def only(self, camera: str, frame: str) -> Recording:
        """The recording of this image alone: little to send to another process."""
        one = replace(self, cameras={camera: self.cameras[camera]}, extra={})
        depth = self.depth_files[camera]
        vars(one)["color_files"] = {camera: {frame: self.color_files[camera][frame]}}
        vars(one)["depth_files"] = {camera: {frame: depth[frame]} if frame in depth else {}}
        return one

    def color(self, camera: str, frame: str) -> np.ndarray:
        """Colour image (height, width, 3), uint8, B G R.

        Raises
        ------
        ConfigError
            The file is damaged, or of another size than dataset.yaml says.
        """
        path = self.color_files[camera][frame]
        image = read_image(path, self._size(camera), "dataset.yaml says")
        if image.dtype != np.uint8:
            raise ConfigError(
                f"{path}: {image.dtype.itemsize * 8} bits a channel seen, 8 needed for colour. Convert it"
            )
        return as_bgr(image)

    def has_depth(self, camera: str, frame: str) -> bool:
        return frame in self.depth_files[camera]

    def depth_m(self, camera: str, frame: str) -> np.ndarray:
        """Depth (height, width), float64, metres as measured, NaN where there is none.

        Raises
        ------
        ConfigError
            The file is damaged, not 16-bit with one channel, or of another size than the colour image.
        """
        path = self.depth_files[camera][frame]
        depth_raw = read_image(path, self._size(camera), "the colour image has")
        if depth_raw.dtype != np.uint16 or depth_raw.ndim != 2:
            channels = 1 if depth_raw.ndim == 2 else depth_raw.shape[2]
            raise ConfigError(
                f"{path}: {depth_raw.dtype.itemsize * 8} bits and {channels} channel(s) seen, depth needs 16 bits and one. "
                "Save the sensor's depth as a 16-bit greyscale PNG, not a picture of it"
            )
        return np.where(depth_raw == 0, np.nan, depth_raw * self.cameras[camera].depth_scale)

    def distances_m(self, camera: str) -> dict[str, float]:
        """Wall distances by frame from distances.csv, metres; empty where there is no such file."""
        path = self.path / camera / "distances.csv"
        if not path.exists():
            return {}
        out: dict[str, float] = {}
        for line, row in read_table(path, ("frame", "distance_m")):
            distance_m = number(path, line, "distance_m", row["distance_m"])
            if distance_m <= 0:
                raise ConfigError(
                    f"{path}: line {line}: distance_m: {distance_m:g} seen, more than 0 needed. Correct it"
                )
            _add_once(out, path, line, row["frame"], distance_m)
        return out

    def timestamps_us(self, camera: str) -> dict[str, tuple[float, float]]:
        """(colour, depth) time stamps by frame from timestamps.csv, microseconds; NaN where one is missing."""
        path = self.path / camera / "timestamps.csv"
        if not path.exists():
            return {}
        out: dict[str, tuple[float, float]] = {}
        for line, row in read_table(path, ("frame", "color_us", "depth_us")):
            color_us, depth_us = (number_or_nan(path, line, key, row[key]) for key in ("color_us", "depth_us"))
            _add_once(out, path, line, row["frame"], (color_us, depth_us))
        return out

    def digest(self) -> str:
        """SHA-256 over names and contents of dataset.yaml and all images: says which recording a result is from."""
        total = hashlib.sha256((self.path / "dataset.yaml").read_bytes())
        for files in (self.color_files, self.depth_files):
            for camera in files:
                for path in files[camera].values():
                    total.update(str(path.relative_to(self.path)).encode())
                    total.update(hashlib.sha256(read_bytes(path, MAX_BYTES)).digest())
        return total.hexdigest()

    def _size(self, camera: str) -> tuple[int, int]:
        return self.cameras[camera].width, self.cameras[camera].height


def open_recording(path: Path) -> Recording:
    """Read dataset.yaml and list the images.

    Raises
    ------
    ConfigError
        No such folder or file, a wrong key, a camera without images, depth that is not registered.
    """
    if not path.is_dir():
        raise ConfigError(f"{path}: no such folder. A recording is a folder with dataset.yaml and one folder a camera")
    if not (path / "dataset.yaml").exists():
        inside = [p.parent.name for p in sorted(path.glob("*/dataset.yaml"))]
        hint = f"Did you mean one of {', '.join(str(path / name) for name in inside)}?" if inside else "Add one"
        raise ConfigError(f"{path}: no dataset.yaml in it. {hint}")
    data = load_yaml(path / "dataset.yaml")
    model = parse(DatasetModel, data, path / "dataset.yaml")
    if not model.depth_registered:
        raise ConfigError(
            f"{path / 'dataset.yaml'}: depth_registered is false; depth must be registered to the colour image. "
            "Register it with the sensor's own software, or record it again with `rgbd-calib capture`"
        )
    cameras = {
        name: CameraInfo(
            camera.width,
            camera.height,
            camera.depth_scale or model.depth_scale,
            camera.serial,
            camera.intrinsics.value() if camera.intrinsics else None,
        )
        for name, camera in model.cameras.items()
    }
    board = model.board.value() if model.board else None
    recording = Recording(path, cameras, board, dict(model.model_extra or {}))
    for camera, files in recording.color_files.items():
        if not files:
            raise ConfigError(
                f"{path}: camera {camera} of dataset.yaml has no images; {path / camera / 'color'}/*.png needed. "
                "Record it, or take it out of dataset.yaml"
            )
    return recording


def write_dataset(
    folder: Path, cameras: Mapping[str, CameraInfo], board: Board | None, extra: Mapping[str, Any] | None = None
) -> None:
    """Write dataset.yaml into `folder`; the depth scale stands with each camera."""
    listed: dict[str, Any] = {}
    for name, info in cameras.items():
        entry: dict[str, Any] = {"width": info.width, "height": info.height, "depth_scale": info.depth_scale}
        if info.serial is not None:
            entry["serial"] = info.serial
        if info.intrinsics is not None:
            entry["intrinsics"] = IntrinsicsModel.of(info.intrinsics).model_dump()
        listed[name] = entry
    data: dict[str, Any] = {"format": "rgbd-calib/dataset", "version": 1, "depth_registered": True, "cameras": listed}
    if board is not None:
        data["board"] = BoardModel.of(board).model_dump(exclude_none=True)
    write_text(folder / "dataset.yaml", dump_yaml(data | dict(extra or {})))


def save_color(recording: Path, camera: str, frame: str, image: np.ndarray) -> None:
    """Write a colour image (h, w, 3), uint8, B G R, as PNG."""
    write_image(recording / camera / "color" / f"{frame}.png", image)


def save_depth(recording: Path, camera: str, frame: str, depth_raw: np.ndarray) -> None:
    """Write a depth image (h, w), uint16 in units of the camera's depth scale, 0 = none, as PNG."""
    write_image(recording / camera / "depth" / f"{frame}.png", depth_raw)


def _images(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """Files by stem, in order. A folder or a file may be a link out of the recording: whoever made it meant it."""
    if not folder.is_dir():
        return {}
    found: dict[str, Path] = {}
    for path in sorted(p for p in folder.iterdir() if p.suffix.lower() in suffixes and not p.name.startswith(".")):
        if not path.stem.isprintable():
            raise ConfigError(f"{folder}: file {path.name!r} seen, printable characters needed. Rename it")
        if path.stem in found:
            raise ConfigError(
                f"{folder}: {found[path.stem].name} and {path.name} seen, one image a frame needed. Delete one, or move it"
            )
        found[path.stem] = path
    return found


def _add_once(out: dict[str, T], path: Path, line: int, frame: str, value: T) -> None:
    if frame in out:
        raise ConfigError(f"{path}: line {line}: frame {short(frame)} stands there twice; once is needed. Take one out")
    out[frame] = value

"""Recordings: a folder with dataset.yaml and, for each camera, colour and depth images (see the README)."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.dataset import CameraInfo as CameraInfo
from rgbd_calib.io.dataset import DepthGeometry as DepthGeometry
from rgbd_calib.io.dataset import read_dataset
from rgbd_calib.io.dataset import write_dataset as write_dataset
from rgbd_calib.io.depth_files import depth_in_m, read_depth_raw
from rgbd_calib.io.frame_names import order
from rgbd_calib.io.images import MAX_BYTES, as_bgr, in_8_bits, read_image, write_image
from rgbd_calib.io.layout import FilePatterns, Files, Kind, describe_unused, find_files, find_unused
from rgbd_calib.io.reading import read_bytes
from rgbd_calib.io.tables import number, number_or_nan, read_table, short
from rgbd_calib.io.tables import write_table as write_table
from rgbd_calib.types import Board

T = TypeVar("T")
_REMEDY = "Write where they are with `rgbd-calib init`, or convert them with `rgbd-calib import`"


@dataclass(frozen=True)
class Recording:
    """A recording on disk; images are read when they are asked for."""

    path: Path
    cameras: dict[str, CameraInfo]
    board: Board | None
    extra: dict[str, Any]
    """Keys of dataset.yaml that have no meaning for the images."""
    files: FilePatterns | None = None
    """Where the images lie, if not in CAM/color and CAM/depth."""
    synchronous: bool = True
    """Equal stems are the same instant."""
    listed: Mapping[Kind, Files] | None = field(default=None, repr=False)
    """The images, where they are known; None: those in the folder."""

    @cached_property
    def _files(self) -> Mapping[Kind, Files]:
        return self.listed or find_files(self.path, list(self.cameras), self.files)

    @property
    def color_files(self) -> Files:
        """Colour files by camera and frame, frames in order."""
        return self._files["color"]

    @property
    def depth_files(self) -> Files:
        """Depth files by camera and frame."""
        return self._files["depth"]

    @property
    def ir_files(self) -> Files:
        """Infrared files by camera and frame; they have the geometry of the camera's depth."""
        return self._files["ir"]

    @property
    def color_cameras(self) -> tuple[str, ...]:
        """All but the depth cameras of a split recording."""
        return tuple(name for name, info in self.cameras.items() if info.mount is None)

    @property
    def cameras_with_depth(self) -> tuple[str, ...]:
        """Those that have depth images."""
        return tuple(name for name in self.cameras if self.depth_files[name])

    @property
    def depth_registered(self) -> bool:
        """Depth of every camera has the geometry of its colour image."""
        return all(info.depth is None for info in self.cameras.values())

    @property
    def frames(self) -> tuple[str, ...]:
        """Stems of all frames of all cameras, in order: numbers by their value."""
        return tuple(sorted({frame for files in self.color_files.values() for frame in files}, key=order))

    @cached_property
    def unused(self) -> tuple[str, ...]:
        """Files under the cameras that are not read, as paths in the recording."""
        return find_unused(self.path, list(self.cameras), self.files, self._files)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What whoever uses the recording should know, a sentence each."""
        if not self.unused:
            return ()
        return (f"{self.path}: {len(self.unused)} files are not read: {describe_unused(self.unused)}",)

    def only(self, camera: str, frame: str) -> Recording:
        """The recording of this image alone: little to send to another process."""
        listed: dict[Kind, Files] = {
            kind: {camera: {frame: files[camera][frame]} if frame in files[camera] else {}}
            for kind, files in self._files.items()
        }
        return replace(self, cameras={camera: self.cameras[camera]}, extra={}, listed=listed)

    def color(self, camera: str, frame: str) -> np.ndarray:
        """Colour image (height, width, 3), uint8, B G R.

        Raises
        ------
        ConfigError
            The file is damaged, or of another size than dataset.yaml says.
        """
        path = self.color_files[camera][frame]
        info = self.cameras[camera]
        if info.mount is not None:
            return as_bgr(in_8_bits(self._infrared(path, (info.width, info.height))))
        image = read_image(path, (info.width, info.height), "dataset.yaml says")
        if image.dtype != np.uint8:
            raise ConfigError(
                f"{path}: {image.dtype.itemsize * 8} bits a channel seen, 8 needed for colour. Convert it"
            )
        return as_bgr(image)

    def has_depth(self, camera: str, frame: str) -> bool:
        return frame in self.depth_files[camera]

    def depth_m(self, camera: str, frame: str) -> np.ndarray:
        """Depth registered to colour (height, width), float64, metres as measured, NaN where there is none.

        Raises
        ------
        ConfigError
            Depth of this camera is not registered to colour (see :meth:`depth_own_m`); the file is damaged, no depth image,
            or of another size than the colour image.
        """
        if self.cameras[camera].depth is not None:
            raise ConfigError(
                f"{self.path}: depth of camera {camera} is not registered to colour, and registered depth is needed here. "
                "Register it with the sensor's own software, or leave its depth folder out"
            )
        return self.depth_own_m(camera, frame)

    def depth_own_m(self, camera: str, frame: str) -> np.ndarray:
        """Depth in its own geometry (height, width), float64, metres as measured, NaN where there is none.

        Raises
        ------
        ConfigError
            The file is damaged, no depth image, or of another size than the camera's depth has.
        """
        path, info = self.depth_files[camera][frame], self.cameras[camera]
        who = "the colour image has" if info.depth is None else "dataset.yaml says for depth"
        raw = read_depth_raw(path, info.depth_size, who)
        return depth_in_m(raw, info.depth_scale, info.float_unit_m, info.invalid, str(path))

    def ir(self, camera: str, frame: str) -> np.ndarray:
        """Infrared image (height, width), uint8 or uint16, in the geometry of the camera's depth.

        Raises
        ------
        ConfigError
            The file is damaged, has several channels, or is of another size than the camera's depth.
        """
        return self._infrared(self.ir_files[camera][frame], self.cameras[camera].depth_size)

    def _infrared(self, path: Path, size: tuple[int, int]) -> np.ndarray:
        image = read_image(path, size, "depth has")
        if image.ndim == 3 and image.dtype == np.uint8 and np.array_equal(image[..., 0], image[..., 1]):
            image = image[..., 0]  # grey, saved as colour
        if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
            raise ConfigError(
                f"{path}: {image.dtype}, {image.ndim} dimensions seen, 8 or 16 bits and one channel needed"
            )
        return image

    def distances_m(self, camera: str) -> dict[str, tuple[float, float | None]]:
        """Wall distances by frame from distances.csv and their standard deviations, metres, None where none is stated; empty
        where there is no such file."""
        path = self.folder(camera) / "distances.csv"
        if not path.exists():
            return {}
        out: dict[str, tuple[float, float | None]] = {}
        for line, row in read_table(path, ("frame", "distance_m"), ("sd_m",)):
            distance_m = number(path, line, "distance_m", row["distance_m"])
            sd_m = number(path, line, "sd_m", row["sd_m"]) if row.get("sd_m") else None
            for key, value in (("distance_m", distance_m), ("sd_m", sd_m)):
                if value is not None and value <= 0:
                    raise ConfigError(f"{path}: line {line}: {key}: {value:g} seen, more than 0 needed. Correct it")
            _add_once(out, path, line, row["frame"], (distance_m, sd_m))
        return out

    def timestamps_us(self, camera: str) -> dict[str, tuple[float, float]]:
        """(colour, depth) time stamps by frame from timestamps.csv, microseconds; NaN where one is missing."""
        path = self.folder(camera) / "timestamps.csv"
        if not path.exists():
            return {}
        out: dict[str, tuple[float, float]] = {}
        for line, row in read_table(path, ("frame", "color_us", "depth_us")):
            color_us, depth_us = (number_or_nan(path, line, key, row[key]) for key in ("color_us", "depth_us"))
            _add_once(out, path, line, row["frame"], (color_us, depth_us))
        return out

    def folder(self, camera: str) -> Path:
        """Where the tables of a camera are: those of a depth camera in its colour camera's."""
        mount = self.cameras[camera].mount
        return self.path / (camera if mount is None else mount.camera)

    def digest(self) -> str:
        """SHA-256 over names and contents of dataset.yaml and all images: says which recording a result is from."""
        total = hashlib.sha256((self.path / "dataset.yaml").read_bytes())
        for files in (self.color_files, self.depth_files, self.ir_files):
            for camera in files:
                for path in files[camera].values():
                    total.update(str(path.relative_to(self.path)).encode())
                    total.update(self._sha256(path))
        return total.hexdigest()

    def image_digests(self) -> dict[str, dict[str, str]]:
        """First 16 digits of the SHA-256 of every colour image, by camera and frame: says which images a result is from."""
        return {
            camera: {frame: self._sha256(path).hex()[:16] for frame, path in files.items()}
            for camera, files in self.color_files.items()
        }

    def _sha256(self, path: Path) -> bytes:
        if path not in self._digests:
            self._digests[path] = hashlib.sha256(read_bytes(path, MAX_BYTES)).digest()
        return self._digests[path]

    @cached_property
    def _digests(self) -> dict[Path, bytes]:
        return {}


def open_recording(path: Path) -> Recording:
    """Read dataset.yaml and list the images.

    Raises
    ------
    ConfigError
        No such folder or file, a wrong key, a camera without images, depth that is expected and cannot be read.
    """
    if not path.is_dir():
        if path.exists():
            raise ConfigError(
                f"{path}: a recording (a folder) expected, a file seen. Import it: rgbd-calib import {path} -o RECORDING"
            )
        raise ConfigError(f"{path}: no such folder. A recording is a folder with dataset.yaml and one folder a camera")
    if not (path / "dataset.yaml").exists():
        inside = [p.parent.name for p in sorted(path.glob("*/dataset.yaml"))]
        hint = (
            f"Did you mean one of {', '.join(str(path / name) for name in inside)}?"
            if inside
            else f"Write one: rgbd-calib init {path}"
        )
        raise ConfigError(f"{path}: no dataset.yaml in it. {hint}")
    data = read_dataset(path / "dataset.yaml")
    recording = Recording(path, data.cameras, data.board, data.extra, data.files, data.synchronous)
    for camera, files in recording.color_files.items():
        if not files:
            where = f"{path / camera / 'color'}/*.png" if data.files is None else data.files.color
            raise ConfigError(
                f"{path}: camera {camera} of dataset.yaml has no images; {where} needed, {_seen(recording, camera)}. "
                f"{_REMEDY}, or take the camera out of dataset.yaml"
            )
    _check_depth(recording, data.depth_stated, data.files is not None and data.files.depth is None)
    return recording


def _check_depth(recording: Recording, stated_for_all: bool, left_out: bool) -> None:
    """Raise ConfigError where depth is expected, since dataset.yaml or a folder speaks of it, and none can be read.

    `left_out`: dataset.yaml says where images are, and names no depth; a folder of depth is not expected to be read then.
    """
    path = recording.path
    for camera, depth in recording.depth_files.items():
        color = recording.color_files[camera]
        if depth and not set(depth) & {*color, *recording.ir_files[camera]}:
            raise ConfigError(
                f"{path}: camera {camera}: none of its {len(depth)} depth images has the name of a colour image: "
                f"{', '.join([*depth][:3])} and {', '.join([*color][:3])} seen. {_REMEDY}"
            )
        if depth:
            continue
        stated = recording.cameras[camera].depth_stated
        expected = "dataset.yaml states its depth" if stated else "" if left_out else _depth_folder(path / camera)
        if expected:
            raise ConfigError(
                f"{path}: camera {camera}: {expected}, and no depth image can be read ({_seen(recording, camera)}). {_REMEDY}; if the "
                "camera has no depth, take that out"
            )
    if stated_for_all and not any(recording.depth_files.values()):
        raise ConfigError(
            f"{path}: dataset.yaml states a depth scale, and no depth image can be read ({_seen(recording)}). {_REMEDY}; if no "
            "camera has depth, take depth_scale out"
        )


def _seen(recording: Recording, camera: str = "") -> str:
    """Files that are not read, those of the camera if it has some."""
    own = [path for path in recording.unused if path.startswith(f"{camera}/")]
    unused = own or recording.unused
    return f"{describe_unused(unused)} seen" if unused else "no other files seen"


def _depth_folder(folder: Path) -> str:
    """What in a camera's folder speaks of depth; empty where nothing does."""
    try:
        named = sorted(p.name for p in folder.iterdir() if "depth" in p.name.lower() and not p.name.startswith("."))
    except OSError:
        return ""
    return f"{folder / named[0]} is there" if named else ""


def save_color(recording: Path, camera: str, frame: str, image: np.ndarray) -> None:
    """Write a colour image (h, w, 3), uint8, B G R, as PNG."""
    write_image(recording / camera / "color" / f"{frame}.png", image)


def save_depth(recording: Path, camera: str, frame: str, depth_raw: np.ndarray) -> None:
    """Write a depth image (h, w), uint16 in units of the camera's depth scale, 0 = none, as PNG."""
    write_image(recording / camera / "depth" / f"{frame}.png", depth_raw)


def _add_once(out: dict[str, T], path: Path, line: int, frame: str, value: T) -> None:
    if frame in out:
        raise ConfigError(f"{path}: line {line}: frame {short(frame)} stands there twice; once is needed. Take one out")
    out[frame] = value

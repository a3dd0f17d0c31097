"""COLMAP models, text or binary: cameras, and poses from rigs.txt/.bin, or from images where each camera has one.

The centre of COLMAP's top left pixel is (0.5, 0.5). Poses take the world's points to the camera.
https://colmap.github.io/format.html
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.calibrations.common import (
    MAX_BYTES,
    Document,
    FoundCalibration,
    FoundCamera,
    lens,
    numbers,
    rigid_of_quaternion,
)
from rgbd_calib.io.reading import read_bytes
from rgbd_calib.io.tables import short

_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV")
"""In the order of COLMAP's model ids, 0 to 6."""
_COUNTS = (3, 4, 4, 5, 8, 8, 12)


@dataclass(frozen=True)
class _Image:
    camera: int
    name: str
    T_color_world: FloatArray


def recognises(document: Document) -> bool:
    path = document.path
    if path.is_dir():
        return any((path / f"cameras{suffix}").is_file() for suffix in (".txt", ".bin"))
    return path.name in ("cameras.txt", "cameras.bin")


def read(document: Document) -> FoundCalibration:
    folder = document.path if document.path.is_dir() else document.path.parent
    binary = not (folder / "cameras.txt").is_file()
    suffix = ".bin" if binary else ".txt"
    lenses = dict((_binary_cameras if binary else _text_cameras)(folder / f"cameras{suffix}"))
    images: list[_Image] = []
    if (folder / f"images{suffix}").is_file():
        images = list((_binary_images if binary else _text_images)(folder / f"images{suffix}"))
    rig = {} if binary or not (folder / "rigs.txt").is_file() else dict(_text_rig(folder / "rigs.txt"))
    names = _names(lenses, images)
    notes = ["COLMAP does not know metres: poses are taken as they are"]
    used = {camera: [own for own in images if own.camera == camera] for camera in lenses}
    if all(len(own) == 1 for own in used.values()):
        poses = {camera: se3.inverse(own[0].T_color_world) for camera, own in used.items()}
    elif rig and set(rig) == set(lenses):
        poses = {camera: se3.inverse(T_sensor_rig) for camera, T_sensor_rig in rig.items()}
    else:
        poses, notes = {}, ["images are no rig (cameras with several images, or none): their poses are not used"]
    cameras = {names[camera]: FoundCamera(own, poses.get(camera)) for camera, own in lenses.items()}
    return FoundCalibration("COLMAP model", cameras, tuple(notes))


def _names(lenses: dict[int, Intrinsics], images: list[_Image]) -> dict[int, str]:
    """The camera's name of its images: their folder, else their stem, else the camera's number."""
    first = {own.camera: PurePosixPath(own.name) for own in reversed(images)}
    for of_path in (lambda p: p.parts[0] if len(p.parts) > 1 else "", lambda p: p.stem):
        names = {camera: str(of_path(first[camera])) if camera in first else "" for camera in lenses}
        if all(names.values()) and len(set(names.values())) == len(names):
            return names
    return {camera: f"C{camera}" for camera in lenses}


def _lens(path: Path, camera: int, model: str, size: tuple[int, int], values: FloatArray) -> Intrinsics:
    if model not in _MODELS:
        raise ConfigError(f"{path}: camera {camera}: model {short(model)} seen, one of {', '.join(_MODELS)} needed")
    p = numbers(path, f"camera {camera}", values, _COUNTS[_MODELS.index(model)])
    if model.startswith("SIMPLE") or model == "RADIAL":
        focal, centre, k = (p[0], p[0]), p[1:3], p[3:]
    else:
        focal, centre, k = (p[0], p[1]), p[2:4], p[4:]
    if model in ("SIMPLE_RADIAL", "RADIAL"):
        k = np.array([*k, *([0.0] * (4 - len(k)))])
    return lens(path, f"camera {camera}", size, focal, centre - 0.5, k, model == "OPENCV_FISHEYE")


def _rows(path: Path, words: int = -1) -> Iterator[tuple[int, list[str]]]:
    """Lines by number, split at spaces: into so many words at most, the last of which may have spaces in it."""
    text = read_bytes(path, MAX_BYTES).decode("utf-8", "replace")
    for number, line in enumerate(text.splitlines(), 1):
        if not line.startswith("#"):
            yield number, line.strip().split(maxsplit=max(words - 1, -1))


def _text_cameras(path: Path) -> Iterator[tuple[int, Intrinsics]]:
    for line, words in _rows(path):
        if not words:
            continue
        if len(words) < 5:
            raise ConfigError(f"{path}: line {line}: CAMERA_ID MODEL WIDTH HEIGHT PARAMS needed. Is it complete?")
        camera, width, height = (int(v) for v in numbers(path, f"line {line}", [words[0], *words[2:4]], 3))
        yield camera, _lens(path, camera, words[1], (width, height), numbers(path, f"line {line}", words[4:]))


def _text_images(path: Path) -> Iterator[_Image]:
    """Every other line; the points are on the lines between, which may be empty."""
    rows = list(_rows(path, 10))
    while rows and not rows[0][1]:
        rows.pop(0)
    for line, words in rows[::2]:
        if not words:
            continue
        if len(words) < 10:
            raise ConfigError(f"{path}: line {line}: IMAGE_ID, pose, CAMERA_ID NAME needed. Is it complete?")
        v = numbers(path, f"line {line}", words[:9], 9)
        yield _Image(int(v[8]), words[9], rigid_of_quaternion(path, f"line {line}", v[1:5], v[5:8]))


def _text_rig(path: Path) -> Iterator[tuple[int, FloatArray]]:
    """T_sensor_rig by camera of the first rig."""
    line, words = next(((n, w) for n, w in _rows(path) if w), (0, []))
    if len(words) < 4 or words[2] != "CAMERA":
        return
    yield int(numbers(path, f"line {line}", words[3:4], 1)[0]), np.eye(4)
    at = 4
    while at + 2 < len(words):
        kind, has_pose = words[at], words[at + 2] == "1"
        if kind == "CAMERA" and has_pose:
            v = numbers(path, f"line {line}", [words[at + 1], *words[at + 3 : at + 10]], 8)
            yield int(v[0]), rigid_of_quaternion(path, f"line {line}", v[1:5], v[5:8])
        at += 10 if has_pose else 3


class _Bytes:
    """A binary file, read in order."""

    def __init__(self, path: Path) -> None:
        self._path, self._data, self._at = path, read_bytes(path, MAX_BYTES), 0

    def take(self, form: str) -> tuple[float, ...]:
        size = struct.calcsize("<" + form)
        if self._at + size > len(self._data):
            raise ConfigError(f"{self._path}: ends early. Is it complete? Copy it again")
        values: tuple[float, ...] = struct.unpack_from("<" + form, self._data, self._at)
        self._at += size
        return values

    def text(self) -> str:
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise ConfigError(f"{self._path}: ends early. Is it complete? Copy it again")
        text = self._data[self._at : end].decode("utf-8", "replace")
        self._at = end + 1
        return text

    def skip(self, size: int) -> None:
        if self._at + size > len(self._data):
            raise ConfigError(f"{self._path}: ends early. Is it complete? Copy it again")
        self._at += size


def _binary_cameras(path: Path) -> Iterator[tuple[int, Intrinsics]]:
    data = _Bytes(path)
    for _ in range(int(data.take("Q")[0])):
        camera, model, width, height = (int(v) for v in data.take("IiQQ"))
        if not 0 <= model < len(_MODELS):
            raise ConfigError(f"{path}: camera {camera}: model {model} seen, 0 to {len(_MODELS) - 1} needed")
        values = np.array(data.take(f"{_COUNTS[model]}d"))
        yield camera, _lens(path, camera, _MODELS[model], (width, height), values)


def _binary_images(path: Path) -> Iterator[_Image]:
    data = _Bytes(path)
    for i in range(int(data.take("Q")[0])):
        v = data.take("I7dI")
        name, points = data.text(), int(data.take("Q")[0])
        data.skip(24 * points)
        yield _Image(int(v[8]), name, rigid_of_quaternion(path, f"image {i}", v[1:5], v[5:8]))

"""RGB-D folders of the Technical University of Munich: rgb.txt and depth.txt, lines of `seconds file`.

The depth images hold 5000 units a metre, registered to colour.
https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.files import read_bytes
from rgbd_calib.io.foreign.source import Kind, Picture, Stamps
from rgbd_calib.io.images import as_bgr, read_image
from rgbd_calib.io.tables import short

DEPTH_SCALE = 1 / 5000
MAX_LIST_BYTES = 64 << 20
MAX_PATH = 500
MAX_SECONDS = 1e10
"""Since 1970, the year 2286."""


def is_tum(path: Path) -> bool:
    """True for a folder with rgb.txt."""
    return (path / "rgb.txt").is_file()


class TumFolder:
    """One camera from a TUM folder."""

    def __init__(self, path: Path, camera: str) -> None:
        self.name = str(path)
        self.depth_scale = DEPTH_SCALE
        self.remarks: tuple[str, ...] = ()
        self.intrinsics: Mapping[str, Intrinsics] = {}
        self._path = path
        self._camera = camera
        self._lists: dict[Kind, list[tuple[int, str]]] = {"color": _read_list(path / "rgb.txt")}
        if (path / "depth.txt").exists():
            self._lists["depth"] = _read_list(path / "depth.txt")

    def stamps(self) -> Mapping[str, Stamps]:
        return {self._camera: {kind: [t for t, _ in entries] for kind, entries in self._lists.items()}}

    def pictures(self) -> Iterator[Picture]:
        entries = [(t, kind, i, f) for kind, listed in self._lists.items() for i, (t, f) in enumerate(listed)]
        for _, kind, index, file in sorted(entries):
            yield Picture(self._camera, kind, index, _read_image(self._path / file, kind))


def _read_list(path: Path) -> list[tuple[int, str]]:
    entries = []
    try:
        lines = read_bytes(path, MAX_LIST_BYTES).decode("utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: cannot be read as text ({error}). Copy the recording again") from error
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        words = line.split()
        try:
            seconds, file = float(words[0]), PurePosixPath(words[1])
            if not 0 <= seconds < MAX_SECONDS or len(words[1]) > MAX_PATH:
                raise ValueError
        except (ValueError, IndexError):
            raise ConfigError(f"{path}: line {number}: {short(line)} seen, `seconds file` needed. Correct it") from None
        if file.is_absolute() or ".." in file.parts or PureWindowsPath(file).drive or not words[1].isprintable():
            raise ConfigError(
                f"{path}: line {number}: {short(words[1])} seen; only files inside {path.parent} are read. Copy it there"
            )
        entries.append((round(seconds * 1e6), words[1]))
    return entries


def _read_image(path: Path, kind: Kind) -> np.ndarray:
    if not os.path.isfile(path):  # false for names that no disk takes
        raise ConfigError(f"{path}: no such image; {kind}.txt lists it. Copy the recording again")
    image = read_image(path)
    if kind == "color":
        if image.dtype != np.uint8:
            raise ConfigError(f"{path}: {image.dtype} seen, 8 bits a channel needed for colour. Convert it")
        return as_bgr(image)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise ConfigError(f"{path}: {image.dtype} with {image.ndim} dimensions seen, 16 bits and one channel needed")
    return image

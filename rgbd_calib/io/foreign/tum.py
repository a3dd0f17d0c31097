"""RGB-D folders of the Technical University of Munich, and of those that follow it (Bonn, ICL-NUIM): rgb.txt and depth.txt,
lines of `seconds file`, or associations.txt, lines of `seconds file seconds file`, depth first or colour first.

Depth is registered to colour. TUM's has 5000 units a metre, others 1000, and no file says so.
https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.foreign.pictures import read_picture
from rgbd_calib.io.foreign.source import Encoded, Kind, Source, SourceCamera, SourceImage, Stamps, Wanted
from rgbd_calib.io.layout import others
from rgbd_calib.io.reading import read_bytes
from rgbd_calib.io.tables import short

MAX_LIST_BYTES = 64 << 20
MAX_PATH = 500
MAX_SECONDS = 1e10
"""Since 1970, the year 2286."""


def is_tum(path: Path) -> bool:
    """True for a folder with rgb.txt, or with pairs of files."""
    return (path / "rgb.txt").is_file() or _associations(path) is not None


class TumFolder(Source):
    """One camera from a TUM folder."""

    def __init__(self, path: Path, camera: str) -> None:
        self.name = str(path)
        self._path = path
        self._camera = camera
        self._lists: dict[Kind, list[tuple[int, str]]] = {}
        pairs = _associations(path)
        if (path / "rgb.txt").is_file() or pairs is None:
            self._lists["color"] = _read_list(path / "rgb.txt")
            if (path / "depth.txt").exists():
                self._lists["depth"] = _read_list(path / "depth.txt")
        else:
            first, second = _read_list(pairs, 0), _read_list(pairs, 2)
            depth_first = bool(first) and "depth" in first[0][1].lower()
            self._lists = {"color": second, "depth": first} if depth_first else {"color": first, "depth": second}
        self.cameras = {camera: SourceCamera(registered=True)}
        left = others(path, {file for entries in self._lists.values() for _, file in entries})
        self.remarks = (left,) if left else ()

    def stamps(self) -> Mapping[str, Stamps]:
        return {self._camera: {kind: [t for t, _ in entries] for kind, entries in self._lists.items()}}

    def pictures(self, wanted: Wanted) -> Iterator[SourceImage]:
        entries = [(t, kind, i, f) for kind, listed in self._lists.items() for i, (t, f) in enumerate(listed)]
        for _, kind, index, file in sorted(entries):
            if wanted(self._camera, kind, index):
                yield SourceImage(self._camera, kind, index, _read_image(self._path / file, kind))


def _associations(path: Path) -> Path | None:
    names = ("associations.txt", "associate.txt", "association.txt", "associated.txt")
    return next((path / name for name in names if (path / name).is_file()), None)


def _read_list(path: Path, column: int = 0) -> list[tuple[int, str]]:
    """(time, file) of the two columns from `column` on, time in us."""
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
            words = words[column : column + 2]
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


def _read_image(path: Path, kind: Kind) -> np.ndarray | Encoded:
    if not os.path.isfile(path):  # false for names that no disk takes
        raise ConfigError(f"{path}: no such image; {kind}.txt lists it. Copy the recording again")
    return read_picture(path, kind)

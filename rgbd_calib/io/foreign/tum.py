"""RGB-D folders of the Technical University of Munich: rgb.txt and depth.txt, lines of `seconds file`.

The depth images hold 5000 units a metre, registered to colour.
https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.foreign.source import Kind, Picture, Stamps

DEPTH_SCALE = 1 / 5000


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
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text ({error})") from error
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        words = line.split()
        try:
            entries.append((round(float(words[0]) * 1e6), words[1]))
        except (ValueError, IndexError):
            raise ConfigError(f"{path}: line {number}: {line!r} seen, `seconds file` needed") from None
    return entries


def _read_image(path: Path, kind: Kind) -> np.ndarray:
    flag = cv2.IMREAD_COLOR if kind == "color" else cv2.IMREAD_UNCHANGED
    image = cv2.imread(str(path), flag) if path.is_file() else None
    if image is None:
        raise ConfigError(f"{path}: no such image, or damaged; {kind}.txt lists it. Copy the recording again")
    if kind == "depth" and (image.dtype != np.uint16 or image.ndim != 2):
        raise ConfigError(f"{path}: {image.dtype} with {image.ndim} dimensions seen, 16 bits and one channel needed")
    return image

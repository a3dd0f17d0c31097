"""Is an output also an input? Files are compared on disk, so that links, hard links and case-insensitive names are found."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.images import DEPTH_SUFFIXES, SUFFIXES

_OF_RECORDINGS = ("dataset.yaml", "capture.yaml", "frame_sets.csv", "timestamps.csv", "distances.csv")
_IMAGE_FOLDERS = ("color", "depth", "ir")
_IMAGES = (*SUFFIXES, *DEPTH_SUFFIXES)
"""Of recordings whose dataset.yaml has patterns: their images may be in any folder."""
_DEPTH = 4
"""Folders within each other that a recording has, and one more."""


def refuse_input(output: Path, inputs: Iterable[Path]) -> None:
    """Raise ConfigError where writing `output` would replace one of the inputs, or a part of it.

    Parameters
    ----------
    output
        A file, or a folder that is replaced as a whole. What does not exist yet replaces nothing.
    inputs
        Files and folders that are read; those that do not exist are passed over.
    """
    if not os.path.exists(output):
        return
    for source in filter(os.path.exists, inputs):
        if _same(output, source):
            raise ConfigError(f"{output}: is also the input {source}. Choose another name for the output")
        if output.is_dir():
            if any(_holds(output, folder) for folder in {_folder(p) for p in (source, *_links(source))}):
                raise ConfigError(f"{output}: holds the input {source}, or a part of it. Choose another output folder")
        elif source.is_dir() and _is_part(output, source):
            raise ConfigError(f"{output}: is a part of the input {source}. Choose another name for the output")


def refuse_inside(output: Path, inputs: Iterable[Path]) -> None:
    """Raise ConfigError where the folder `output` would lie in a folder that is read: whoever reads that again finds both."""
    above = [p for p in Path(os.path.realpath(output)).parents if p.exists()]
    for source in inputs:
        if source.is_dir() and any(os.path.samefile(source, folder) for folder in above):
            raise ConfigError(f"{output}: lies in the input {source}. Choose an output folder beside it")


def _same(a: Path, b: Path) -> bool:
    return os.path.exists(a) and os.path.exists(b) and os.path.samefile(a, b)


def _folder(path: Path) -> str:
    """The real folder that `path` lies in, or is."""
    real = os.path.realpath(path)
    return real if os.path.isdir(real) else os.path.dirname(real)


def _holds(folder: Path, real: str) -> bool:
    """True where `folder` is the folder `real`, or one above it."""
    return any(os.path.samefile(folder, above) for above in (Path(real), *Path(real).parents))


def _is_part(file: Path, recording: Path) -> bool:
    """True where `file` is one of those that a recording is read from, by its own name or through a link."""
    if _holds(recording, _folder(file)):
        real = Path(os.path.realpath(file))
        if real.name in _OF_RECORDINGS or real.parent.name in _IMAGE_FOLDERS or real.suffix.lower() in _IMAGES:
            return True
    return any(_same(file, part) for part in (*(recording / name for name in _OF_RECORDINGS), *_links(recording)))


def _links(folder: Path, depth: int = _DEPTH) -> Iterator[Path]:
    """Links below `folder` that lead to something, those in linked folders too."""
    try:
        entries = sorted(os.scandir(folder), key=lambda entry: entry.name) if folder.is_dir() and depth else []
    except OSError:
        return
    for entry in entries:
        if entry.is_symlink() and os.path.exists(entry.path):
            yield Path(entry.path)
        if entry.is_dir():
            yield from _links(Path(entry.path), depth - 1)

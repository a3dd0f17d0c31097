"""Detections kept by content: the same image, board, settings and detector give the same view, whatever the file's name.

The key holds all that the result depends on; the bytes of the images stand in it, not their names and times. A view
read back is the one that was stored, bit for bit.

A file's hash is taken from an earlier run where its size, times and inode are still the same, so that a second run reads no
image. Times that are younger than SETTLED_NS when the file is hashed do not count: a file may change twice within a tick of
its clock (the "racy" entries of git's index).
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import platform
import time
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL
import scipy

import rgbd_calib
from rgbd_calib.errors import ConfigError
from rgbd_calib.io.cache import FileCache
from rgbd_calib.io.images import MAX_BYTES
from rgbd_calib.io.reading import read_chunks
from rgbd_calib.io.recording import Recording
from rgbd_calib.pipeline.workers import Workers
from rgbd_calib.types import Board, BoardView
from rgbd_calib.views.detect import DetectParams

Contents = tuple[str, str]
"""SHA-256 of the colour file and of the depth file, empty where there is no depth."""
_FIELDS = ("ids", "corners_px", "depth_m", "depth_pixels")
SETTLED_NS = 2_000_000_000
"""The coarsest clock of a file system in use, that of FAT."""


@lru_cache
def detector() -> str:
    """What finds boards here: the sources that take part, and the versions of the libraries below them."""
    root = Path(rgbd_calib.__file__).parent
    read_by = [root / "io" / name for name in ("recording.py", "images.py", "depth_files.py")]
    sources = hashlib.sha256()
    for path in [
        *sorted(root.glob("views/detect/*.py")),
        *sorted(root.glob("geometry/*.py")),
        root / "types.py",
        root / "io" / "fast_png.py",
        *read_by,
    ]:
        sources.update(path.read_bytes() if path.exists() else b"")
    versions = [rgbd_calib.__version__, *(m.__version__ for m in (cv2, np, scipy, PIL)), platform.machine()]
    return " ".join([sources.hexdigest()[:16], *versions])


def contents(recording: Recording, camera: str, frame: str) -> Contents | None:
    """Hashes of the files of an image, or None where one cannot be read."""
    depth = recording.depth_files[camera].get(frame)
    try:
        return _sha256(recording.color_files[camera][frame]), "" if depth is None else _sha256(depth)
    except ConfigError:
        return None


def key_of(found: Contents, recording: Recording, camera: str, board: Board | None, params: DetectParams) -> str:
    """The key of a view: SHA-256 over everything that it depends on."""
    info = recording.cameras[camera]
    parts: dict[str, Any] = {
        "color": found[0],
        "depth": found[1],
        "size": [info.width, info.height],
        "depth_unit": [info.depth_scale, info.float_unit_m, list(info.invalid)],
        "board": None if board is None else asdict(replace(board, shape=None)),
        "params": asdict(params),
        "detector": detector(),
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


class DetectionCache:
    """What is known of a recording's images, and what becomes known; with no folder, nothing."""

    def __init__(self, recording: Recording, board: Board | None, params: DetectParams, workers: Workers) -> None:
        self._recording, self._board, self._params, self._workers = recording, board, params, workers
        self._files = None if workers.cache is None else FileCache(workers.cache, workers.say)
        self._missing: dict[tuple[str, str], Contents] = {}
        self._hashed: dict[str, dict[str, Any]] = {}
        """By camera and frame: [stamp, hashes] of this and of earlier runs."""
        self._changed: set[str] = set()
        self.found = 0
        """Images that were known."""

    def look(self, camera: str, frame: str) -> tuple[BoardView | None] | None:
        """(view, or None where the board is not in the image,), or None where the image is not known."""
        now = None if self._files is None else self._contents(self._files, camera, frame)
        if self._files is None or now is None:
            return None
        data = self._files.get(key_of(now, self._recording, camera, self._board, self._params))
        known = None if data is None else read_entry(data, camera, frame)
        if known is None:
            self._missing[camera, frame] = now
        else:
            self.found += 1
        return known

    def keep(self, camera: str, frame: str, view: BoardView | None, seen: Contents | None, by: str | None) -> None:
        """Store a view that was asked for in vain, unless the files, or the program, have changed in the meantime."""
        asked = self._missing.pop((camera, frame), None)
        if self._files is not None and asked is not None and asked == seen and by == detector():
            self._files.put(key_of(asked, self._recording, camera, self._board, self._params), entry(view))

    def close(self) -> None:
        """Say how much was known."""
        if self._files is not None:
            for camera in sorted(self._changed):
                self._files.put(self._hashes_key(camera), json.dumps(self._hashed[camera]).encode())
            self._files.close()
        if self.found:
            images = sum(map(len, self._recording.color_files.values()))
            self._workers.say(f"{self._recording.path}: {self.found} of {images} images from the cache")

    def _contents(self, files: FileCache, camera: str, frame: str) -> Contents | None:
        """As :func:`contents`, without reading files that are as they were when they were hashed."""
        stamp = _stamp(self._recording, camera, frame)
        if camera not in self._hashed:
            self._hashed[camera] = _read_hashes(files.get(self._hashes_key(camera)))
        before = self._hashed[camera].get(frame)
        if stamp is not None and before is not None and before[0] == stamp:
            return before[1][0], before[1][1]
        now = contents(self._recording, camera, frame)
        if stamp is not None and now is not None and time.time_ns() - max(stamp[1::4] + stamp[2::4]) > SETTLED_NS:
            self._hashed[camera][frame] = [stamp, now]
            self._changed.add(camera)
        return now

    def _hashes_key(self, camera: str) -> str:
        return hashlib.sha256(json.dumps(["hashes", str(self._recording.path.absolute()), camera]).encode()).hexdigest()


def entry(view: BoardView | None) -> bytes:
    """A view as bytes: one table in numpy's own format, which holds every bit and no code; nothing for no view."""
    if view is None:
        return b""
    columns = [getattr(view, name) for name in _FIELDS]
    kinds = [(name, c.dtype, c.shape[1:]) for name, c in zip(_FIELDS, columns, strict=True)]
    table = np.empty(len(view.ids), dtype=kinds)
    for name, column in zip(_FIELDS, columns, strict=True):
        table[name] = column
    stream = io.BytesIO()
    np.save(stream, table, allow_pickle=False)
    return stream.getvalue()


def read_entry(data: bytes, camera: str, frame: str) -> tuple[BoardView | None] | None:
    """(what :func:`entry` was given,), or None where this is no entry."""
    if not data:
        return (None,)
    try:
        table = np.load(io.BytesIO(data), allow_pickle=False)
        ids, corners, depth, pixels = (np.ascontiguousarray(table[name]) for name in _FIELDS)
    except (ValueError, EOFError, LookupError, TypeError):
        return None
    if ids.ndim != 1 or corners.shape != (len(ids), 2) or not depth.shape == pixels.shape == ids.shape:
        return None
    return (BoardView(camera, frame, ids, corners, depth, pixels),)


def _stamp(recording: Recording, camera: str, frame: str) -> list[int] | None:
    """What changes with the files of an image, times in ns; None where one cannot be seen."""
    depth = recording.depth_files[camera].get(frame)
    try:
        seen = [os.stat(path) for path in (recording.color_files[camera][frame], depth) if path is not None]
    except OSError:
        return None
    return [n for s in seen for n in (s.st_size, s.st_mtime_ns, s.st_ctime_ns, s.st_ino)]


def _read_hashes(data: bytes | None) -> dict[str, Any]:
    try:
        hashed = json.loads(data) if data else {}
    except ValueError:
        return {}
    return hashed if isinstance(hashed, dict) else {}


def _sha256(path: Path) -> str:
    total = hashlib.sha256()
    for part in read_chunks(path, MAX_BYTES):
        total.update(part)
    return total.hexdigest()

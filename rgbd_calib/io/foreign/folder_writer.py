"""Images of an import, written as they come into a folder beside the recording, so that an interrupted import goes on.

Each image is written under a hidden name and then renamed: what has its name is whole. The folder is that of one import of
the same sources; another one starts anew.
"""

from __future__ import annotations

import errno
import shutil
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.io.files import dump_yaml, load_yaml, write_text
from rgbd_calib.io.foreign.pictures import check_picture
from rgbd_calib.io.foreign.source import Encoded, Kind
from rgbd_calib.io.images import decode_image
from rgbd_calib.io.layout import KINDS

MARK = "import.yaml"
_WRITERS, _PENDING = 2, 8
"""Threads that encode and write, and pictures that may wait for them."""


class ImportFolder:
    """A folder of images that grows.

    Parameters
    ----------
    out
        The recording that it will become.
    fingerprint
        What the import is of; a folder of another import is removed.
    """

    def __init__(self, out: Path, fingerprint: Mapping[str, Any]) -> None:
        self.path = out.with_name(f".{out.name}.importing")
        own = {"format": "rgbd-calib/import", "version": 1, **fingerprint}
        self.resumed = 0
        """Pictures that were there."""
        if self.path.exists() and not self._is_of(own):
            remove_import(self.path)
        self._there: dict[tuple[str, Kind], set[str]] = {}
        if self.path.exists():
            for camera in (p for p in self.path.iterdir() if p.is_dir()):
                for kind in KINDS:
                    self._there[camera.name, kind] = self._stems(camera / kind)
            self.resumed = sum(map(len, self._there.values()))
        else:
            self._guarded(lambda: self.path.mkdir(parents=True))
            write_text(self.path / MARK, dump_yaml(own))
        self._pool = ThreadPoolExecutor(_WRITERS, thread_name_prefix="import")
        self._pending: deque[Future[None]] = deque()
        self._shapes: dict[tuple[str, Kind], tuple[int, ...]] = {}
        self.written = 0

    def has(self, camera: str, kind: Kind, frame: str) -> bool:
        return frame in self._there.get((camera, kind), ())

    def put(self, camera: str, kind: Kind, frame: str, pixels: np.ndarray | Encoded, where: str) -> None:
        """Write a picture in the background; waits where too many are on their way.

        Raises
        ------
        ConfigError
            This picture, or one before it, is damaged or of another size than those before.
        CalibrationError
            The disk is full.
        """
        while len(self._pending) >= _PENDING:
            self._finish_one()
        self._pending.append(self._pool.submit(self._write, camera, kind, frame, pixels, where))

    def finish(self) -> None:
        """Wait until all is written; see :meth:`put`."""
        while self._pending:
            self._finish_one()

    def close(self) -> None:
        """Drop what is not written yet."""
        self._pool.shutdown(cancel_futures=True)

    def _finish_one(self) -> None:
        self._guarded(self._pending.popleft().result)
        self.written += 1

    def _guarded(self, action: Any) -> None:
        try:
            action()
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise Unfinished(
                    f"{self.path}: the disk is full; {self.written + self.resumed} pictures are kept. Free space, then give "
                    "the same command again: it goes on"
                ) from error
            raise ConfigError(
                f"{self.path}: cannot be written ({error.strerror or error}). Choose another folder"
            ) from error

    def _write(self, camera: str, kind: Kind, frame: str, pixels: np.ndarray | Encoded, where: str) -> None:
        if isinstance(pixels, Encoded):
            image = decode_image(pixels.data, where)
            data, suffix = pixels.data, pixels.suffix
        else:
            image = pixels
            data, suffix = _encode(pixels)
        check_picture(image, kind, where)
        shape = image.shape[:2]
        usual = self._shapes.setdefault((camera, kind), shape)
        if shape != usual:
            raise ConfigError(
                f"{where}: {camera}: a {kind} image of {shape[1]}x{shape[0]} px seen, those before have {usual[1]}x{usual[0]}; "
                "one size is needed. Choose one stream, or split the recording"
            )
        folder = self.path / camera / kind
        folder.mkdir(parents=True, exist_ok=True)
        hidden = folder / f".{frame}{suffix}"
        try:
            hidden.write_bytes(data)
            hidden.replace(folder / f"{frame}{suffix}")
        except BaseException:
            hidden.unlink(missing_ok=True)
            raise

    def _is_of(self, own: Mapping[str, Any]) -> bool:
        try:
            return load_yaml(self.path / MARK) == own
        except ConfigError:
            return False

    @staticmethod
    def _stems(folder: Path) -> set[str]:
        if not folder.is_dir():
            return set()
        for leftover in folder.glob(".*"):
            leftover.unlink()
        return {path.stem for path in folder.iterdir()}


class Unfinished(CalibrationError):
    """An import that stops, and whose pictures are kept: the next one goes on."""


def remove_import(folder: Path) -> None:
    """Remove the folder of an import.

    Raises
    ------
    ConfigError
        It is none of this program's.
    """
    if not (folder / MARK).is_file() and any(folder.iterdir()):
        raise ConfigError(f"{folder}: exists already, and is no unfinished import. Move it, or choose another output")
    shutil.rmtree(folder)


def _encode(pixels: np.ndarray) -> tuple[bytes, str]:
    if pixels.dtype == np.float32:
        return cv2.imencode(".tiff", pixels, [cv2.IMWRITE_TIFF_COMPRESSION, 8])[1].tobytes(), ".tiff"
    return cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes(), ".png"

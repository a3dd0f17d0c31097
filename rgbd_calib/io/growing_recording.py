"""A recording that grows while cameras run, so that a kill at any moment leaves all finished frame sets valid.

A frame set's images are written under hidden names, then all renamed; then dataset.yaml lists cameras that are new;
then its times are appended to each timestamps.csv, and last its line to frame_sets.csv: with it the set is finished.
Lines are appended in one write each. dataset.yaml never lists a camera without images.
"""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.io.recording import CameraInfo, DepthGeometry, open_recording, write_dataset
from rgbd_calib.io.schema_base import check_name
from rgbd_calib.io.tables import short
from rgbd_calib.types import Board

TIMESTAMPS_HEADER = "frame,color_us,depth_us"
DISTANCES_HEADER = "frame,distance_m"
_ENCODERS = 2
_FAST = (cv2.IMWRITE_PNG_COMPRESSION, 1)
_STORED = (cv2.IMWRITE_PNG_COMPRESSION, 0, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE)
"""A fifteenth of the time, and a tenth more bytes."""
FRAME_SETS_HEADER = "frame,time_us,spread_us,cameras"


@dataclass(frozen=True)
class CameraImages:
    """What one camera gives to a frame set; without depth, only colour is written."""

    color: np.ndarray
    """(h, w, 3) uint8, B G R."""
    depth_raw: np.ndarray | None
    """(h, w) uint16, 0 = none."""
    color_us: int | None = None
    """Times on the recording's clock; None where unknown."""
    depth_us: int | None = None
    distance_m: float | None = None
    """True distance to the wall, in depth-bias recordings."""
    infrared: np.ndarray | None = None
    """(h, w) uint8 or uint16, in the geometry of depth; None where the camera gives none."""


class GrowingRecording:
    """Frame sets are added from any thread, in any order."""

    def __init__(
        self,
        folder: Path,
        board: Board | None = None,
        *,
        depth_scale: float = 0.001,
        registered: bool = True,
        append: bool = False,
        synchronous: bool = True,
    ) -> None:
        self.folder = folder
        self._synchronous = synchronous
        self._serials: dict[str, str | None] = {}
        self._described: dict[str, CameraInfo] = {}
        self._depth_scale = depth_scale
        self._registered = registered
        self._lock = threading.Lock()
        self._encoders = ThreadPoolExecutor(_ENCODERS, thread_name_prefix="png")
        self._cameras: dict[str, CameraInfo] = {}
        self._board = board
        self._next = 0
        self.finished = 0
        """Frame sets finished by this object."""
        if _occupied(folder):
            if not append:
                raise ConfigError(f"{folder}: exists already. Choose another name, or resume with --append")
            self._continue(board)

    @property
    def cameras(self) -> dict[str, CameraInfo]:
        """Cameras with images so far."""
        return dict(self._cameras)

    @property
    def board(self) -> Board | None:
        return self._board

    def identify(self, serials: Mapping[str, str | None]) -> None:
        """Serial numbers of the cameras, to be noted in dataset.yaml with their first images.

        Raises
        ------
        ConfigError
            A camera's name is none for a folder.
        """
        for camera in serials:
            try:
                check_name(camera)
            except ValueError as error:
                raise ConfigError(f"camera {short(camera)} seen; {error}. Rename it") from None
        self._serials = dict(serials)

    def describe(self, cameras: Mapping[str, CameraInfo]) -> None:
        """What the cameras say of themselves, to be noted in dataset.yaml with their first images."""
        self._described = dict(cameras)

    def reserve(self) -> str:
        """The name of the next frame set."""
        with self._lock:
            self._next += 1
            return f"{self._next - 1:06d}"

    def add(
        self, frame: str, images: Mapping[str, CameraImages], spread_us: int | None = None, compress: bool = True
    ) -> None:
        """Write one frame set whole, or not at all; without compression in a fraction of the time.

        Raises
        ------
        CalibrationError
            The disk is full, or writing fails otherwise; earlier frame sets are untouched.
        """
        renamed: list[Path] = []
        try:
            for temporary, path in self._write_hidden(frame, images, compress):
                temporary.replace(path)
                renamed.append(path)
            with self._lock:
                self._list_new_cameras(images)
                append_lines(self._lines(frame, images, spread_us))
                self.finished += 1
        except (OSError, ConfigError) as error:  # ConfigError: dataset.yaml
            for path in renamed:
                path.unlink(missing_ok=True)
            remove_leftovers(self.folder, frame)
            self._unlist_empty_cameras()
            raise CalibrationError(self._explain(error)) from error

    def _write_hidden(self, frame: str, images: Mapping[str, CameraImages], compress: bool) -> list[tuple[Path, Path]]:
        """Write all images under hidden names, several at once; gives (hidden, final) paths."""
        jobs: list[tuple[Path, Path, np.ndarray]] = []
        for camera, shot in images.items():
            for kind, image in (("color", shot.color), ("depth", shot.depth_raw), ("ir", shot.infrared)):
                folder = self.folder / camera / kind
                if image is not None:
                    jobs.append((folder / f".{frame}.png", folder / f"{frame}.png", image))
        writing = [self._encoders.submit(_write_png, hidden, image, compress) for hidden, _, image in jobs]
        wait(writing)  # all of them, or one would still write after the others were removed
        for done in writing:
            done.result()
        return [(hidden, path) for hidden, path, _ in jobs]

    def _list_new_cameras(self, images: Mapping[str, CameraImages]) -> None:
        """Bring dataset.yaml up to date before the first image of a camera, and before its first depth."""
        now = dict(self._cameras)
        for camera, shot in images.items():
            height, width = shot.color.shape[:2]
            said = self._described.get(camera)
            info = now.get(camera) or CameraInfo(
                width, height, serial=self._serials.get(camera), intrinsics=said.intrinsics if said else None
            )
            scale = said.depth_scale if said else self._depth_scale
            if shot.depth_raw is not None and not info.depth_stated:
                height, width = shot.depth_raw.shape
                own = None if self._registered else DepthGeometry(width, height)
                info = replace(info, depth_scale=scale, depth_stated=True, depth=said.depth if said else own)
            if shot.depth_raw is not None and info.depth_scale != scale:
                raise ConfigError(
                    f"{self.folder / 'dataset.yaml'}: {camera}: {info.depth_scale} m for each unit of depth there, the camera "
                    f"gives {scale}. Set the camera to the same unit, or record into another folder"
                )
            now[camera] = info
        if now != self._cameras:
            self._cameras = now
            self._write_dataset()

    def _unlist_empty_cameras(self) -> None:
        """Take what has no images out of dataset.yaml again: cameras, or their depth, that could not be written."""
        with self._lock:
            there = {}
            for camera, info in self._cameras.items():
                depth = any((self.folder / camera / "depth").glob("[!.]*"))
                if any((self.folder / camera / "color").glob("[!.]*")):
                    bare = CameraInfo(info.width, info.height, serial=info.serial, intrinsics=info.intrinsics)
                    there[camera] = info if depth or not info.depth_stated else bare
            if there == self._cameras:
                return
            self._cameras = there
            if there:
                with suppress(ConfigError):
                    self._write_dataset()
            else:
                (self.folder / "dataset.yaml").unlink(missing_ok=True)

    def _write_dataset(self) -> None:
        cameras = dict(sorted(self._cameras.items()))
        write_dataset(self.folder, cameras, self._board, synchronous=self._synchronous)

    def _lines(
        self, frame: str, images: Mapping[str, CameraImages], spread_us: int | None
    ) -> list[tuple[Path, str, str]]:
        """(file, header, line) of everything that is noted of a frame set; the one that finishes it is the last."""
        lines = []
        for camera, shot in images.items():
            folder = self.folder / camera
            if shot.color_us is not None or shot.depth_us is not None:
                times = f"{frame},{_text(shot.color_us)},{_text(shot.depth_us)}"
                lines.append((folder / "timestamps.csv", TIMESTAMPS_HEADER, times))
            if shot.distance_m is not None:
                lines.append((folder / "distances.csv", DISTANCES_HEADER, f"{frame},{float(shot.distance_m)!r}"))
        first_us = min((shot.color_us for shot in images.values() if shot.color_us is not None), default=None)
        line = f"{frame},{_text(first_us)},{_text(spread_us)},{' '.join(images)}"
        return [*lines, (self.folder / "frame_sets.csv", FRAME_SETS_HEADER, line)]

    def _continue(self, board: Board | None) -> None:
        remove_leftovers(self.folder)
        if not (self.folder / "dataset.yaml").exists():
            return  # a session that ended before its first frame set
        there = open_recording(self.folder)
        if board is not None and there.board is not None and board != there.board:
            raise ConfigError(
                f"{self.folder / 'dataset.yaml'}: board: {there.board} there, {board} given; one recording has one board. "
                "Leave --board out, or record into another folder"
            )
        if there.synchronous != self._synchronous:
            raise ConfigError(
                f"{self.folder / 'dataset.yaml'}: synchronous: {there.synchronous} there, {self._synchronous} wanted; a carried "
                "board (--wave) and frame sets are two recordings. Record into another folder"
            )
        self._board = board or there.board
        self._cameras = dict(there.cameras)
        numbers = [int(frame) for frame in there.frames if frame.isdigit()]
        self._next = max(numbers, default=-1) + 1

    def _explain(self, error: BaseException) -> str:
        error = error if isinstance(error, OSError) else error.__cause__ or error
        kept = f"{self.finished} frame set{'s' if self.finished != 1 else ''} of this session kept"
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return f"{self.folder}: the disk is full; {kept}. Free space, then resume with --append"
        return f"{self.folder}: writing failed ({getattr(error, 'strerror', None) or error}); {kept}. Fix this, then resume with --append"


def append_lines(lines: Sequence[tuple[Path, str, str]]) -> None:
    """Append a line to each (file, header, line), or to none of them."""
    sizes = {path: path.stat().st_size if path.exists() else 0 for path, _, _ in lines}
    try:
        for path, header, line in lines:
            append_line(path, header, line)
    except OSError:
        for path, size in sizes.items():
            if path.exists():
                os.truncate(path, min(size, path.stat().st_size))
        raise


def append_line(path: Path, header: str, line: str) -> None:
    """Append a line in one write; where that fails the file is as it was. A line that a kill cut short is removed.

    Raises
    ------
    OSError
        The disk is full or the folder gone.
    """
    handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
    try:
        size = _whole_lines(handle)
        os.ftruncate(handle, size)
        data = (f"{header}\n" if size == 0 else "") + f"{line}\n"
        try:
            if os.write(handle, data.encode()) != len(data.encode()):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError:
            os.ftruncate(handle, size)
            raise
    finally:
        os.close(handle)


def _whole_lines(handle: int) -> int:
    """Bytes up to the end of the last whole line."""
    size = os.fstat(handle).st_size
    tail = os.pread(handle, 4096, max(0, size - 4096))
    return size - len(tail) + tail.rfind(b"\n") + 1


def remove_leftovers(folder: Path, frame: str = "*") -> None:
    """Remove images that were being written when a program died."""
    for kind in ("color", "depth", "ir"):
        for path in folder.glob(f"*/{kind}/.{frame}.png"):
            path.unlink(missing_ok=True)


def _write_png(path: Path, image: np.ndarray, compress: bool) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", image, _FAST if compress else _STORED)[1].tobytes())


def _occupied(folder: Path) -> bool:
    """A folder in which a capture failed before its first image holds its log only, and counts as free."""
    return folder.exists() and (not folder.is_dir() or any(p.name != "capture.yaml" for p in folder.iterdir()))


def _text(value: int | None) -> str:
    return "" if value is None else str(value)

"""Writes frame sets in a thread of its own, in their order: readers never wait for the disk, and memory stays bounded."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor

from rgbd_calib.errors import RgbdCalibError
from rgbd_calib.io.growing_recording import CameraImages, GrowingRecording

MAX_PENDING = 6
"""Frame sets in memory, waiting or being written: 4 cameras x 1.5 MB each."""


class FrameSetWriter:
    """A bounded queue in front of a growing recording; use as a context manager, which waits for what is queued.

    While more than a quarter of the queue is waiting, images are written without compression.
    """

    def __init__(self, recording: GrowingRecording, max_pending: int = MAX_PENDING) -> None:
        self._recording = recording
        self._room = threading.BoundedSemaphore(max_pending)
        self._relaxed = max_pending // 4
        self._pending = 0
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="writer")
        self._failure: RgbdCalibError | None = None
        self.waited_s = 0.0
        """How long the caller has been held up because writing was slower than capturing."""

    def __enter__(self) -> FrameSetWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(wait=True)

    @property
    def finished(self) -> int:
        """Frame sets on the disk."""
        return self._recording.finished

    def submit(self, images: Mapping[str, CameraImages], spread_us: int | None) -> str:
        """Queue a frame set and return its name; waits while the queue is full.

        Raises
        ------
        RgbdCalibError
            An earlier frame set could not be written.
        """
        start_s = time.monotonic()
        self._room.acquire()
        self.waited_s += time.monotonic() - start_s
        try:
            self.check()
            frame = self._recording.reserve()
            self._count(1)
            self._pool.submit(self._write, frame, images, spread_us)
        except BaseException:
            self._room.release()
            raise
        return frame

    def flush(self) -> None:
        """Wait until everything queued is written, and raise what went wrong."""
        self._pool.shutdown(wait=True)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="writer")
        self.check()

    def check(self) -> None:
        """Raise the first error that a writing thread met."""
        if self._failure is not None:
            raise self._failure

    def _count(self, more: int) -> int:
        with self._lock:
            self._pending += more
            return self._pending

    def _write(self, frame: str, images: Mapping[str, CameraImages], spread_us: int | None) -> None:
        try:
            if self._failure is None:  # after a full disk, smaller sets that might still fit would leave holes
                self._recording.add(frame, images, spread_us, compress=self._count(0) <= max(1, self._relaxed))
        except RgbdCalibError as error:
            self._failure = error
        except Exception as error:
            self._failure = RgbdCalibError(f"{frame}: could not be written ({type(error).__name__}: {error})")
        finally:
            self._count(-1)
            self._room.release()

"""The OpenNI runtime in a process of its own, to play files: it crashes and hangs on damaged ones."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from rgbd_calib.errors import ConfigError, RgbdCalibError
from rgbd_calib.io.processes import context
from rgbd_calib.sensors.frames import SensorFrame

END_S = 2.0
"""Silence of the runtime that means the end, where the file holds fewer frames than it says."""
_SILENCE_S = 60.0  # of the process: it starts, loads the runtime and opens the file within a second or two
_MEMORY_BYTES = 4 << 30


@dataclass(frozen=True)
class OniHead:
    """What an .oni file says of itself."""

    mirrored: bool
    depth_unit_m: float


def play(path: Path, redist: Path | None) -> Iterator[OniHead | SensorFrame]:
    """The head of the file, then all its frames in order.

    Raises
    ------
    CalibrationError, ConfigError
        There is no runtime, it does not open the file, or the file ends it.
    """
    alone: Any = context("spawn")
    ours, theirs = alone.Pipe(duplex=False)
    process = alone.Process(target=_play, args=(str(path.absolute()), redist, theirs), daemon=True)
    process.start()
    theirs.close()
    try:
        while (got := _receive(path, ours, process)) is not None:
            yield got
    finally:
        process.kill()
        process.join()
        ours.close()


def _receive(path: Path, ours: Connection, process: Any) -> Any:
    if not ours.poll(_SILENCE_S):
        raise ConfigError(
            f"{path}: the OpenNI runtime hangs on it; the file is damaged. Copy it again, or record it again"
        )
    try:
        got = ours.recv()
    except EOFError:
        process.join()
        raise ConfigError(
            f"{path}: the OpenNI runtime crashed on it (exit status {process.exitcode}); the file is damaged. Copy it again, "
            "or record it again"
        ) from None
    if isinstance(got, Exception):
        raise got
    return got


def _play(path: str, redist: Path | None, out: Connection) -> None:
    """In the other process: send the head, the frames, and None; or the error."""
    from rgbd_calib.sensors.openni2 import load_runtime

    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # C++ says its last words there
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the first process's to handle
    with suppress(ImportError):  # Windows
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))
    try:
        with closing(load_runtime(redist)) as runtime, closing(runtime.open(path)) as device:
            device.create_streams()
            out.send(OniHead(device.is_mirrored(), device.depth_unit_m()))
            left = sum(device.frame_count().values())
            device.play_as_fast_as_read()
            device.start()
            while left > 0 and (frame := device.wait_frame(END_S)) is not None:
                left -= 1
                out.send(frame)
        out.send(None)
    except RgbdCalibError as error:
        out.send(error)
    except BrokenPipeError:
        pass
    except Exception as error:  # the binding raises what it met, of any type
        words = " ".join(str(error).split())[:200]
        out.send(ConfigError(f"{path}: damaged ({words or type(error).__name__}). Copy it again, or record it again"))

"""Video files, through PyAV."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.foreign.damaged import faults


@contextmanager
def open_video(path: Path) -> Iterator[Any]:
    """A video file by PyAV.

    Raises
    ------
    ConfigError
        PyAV is missing, or the file cannot be read.
    """
    try:
        import av
    except ImportError:
        raise ConfigError(f"{path}: videos need a package. Install it: pip install 'rgbd-calib[video]'") from None
    if not path.is_file():
        raise ConfigError(f"{path}: no such file")
    av.logging.set_level(None)
    with video_faults(path):
        file = av.open(str(path))
    try:
        yield file
    finally:
        file.close()


def video_faults(path: Path) -> AbstractContextManager[None]:
    """What PyAV raises becomes an error for people."""
    return faults(str(path), "a video")

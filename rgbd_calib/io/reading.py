"""Safe reading of untrusted files: only regular files are opened, and only up to a size limit.

Reading a named pipe, a socket or a device may never end. They are refused before they are opened, because opening a
device can already change its state.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from rgbd_calib.errors import ConfigError

_CHUNK = 1 << 20
_OPEN = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def kind_of(mode: int) -> str:
    """What a file's mode says it is, in words."""
    return next((words for test, words in _KINDS if test(mode)), "a regular file")


def check_regular(path: Path, status: os.stat_result) -> None:
    """Raise ConfigError unless the file is a regular one."""
    if not stat.S_ISREG(status.st_mode):
        raise ConfigError(
            f"{path}: a regular file was expected, {kind_of(status.st_mode)} was found. Save its content to a file first"
        )


@contextmanager
def open_regular(path: Path, most: int) -> Iterator[BinaryIO]:
    """A regular file of at most `most` bytes, open for reading.

    Raises
    ------
    ConfigError
        The file does not exist, cannot be read, is not a regular file, or is larger.
    """
    try:
        _check(path, path.stat(), most)
        stream = os.fdopen(os.open(path, _OPEN), "rb")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:  # ValueError: a name with a null byte
        raise _unreadable(path, error) from error
    with stream:
        _check(path, os.fstat(stream.fileno()), most)  # it may have been replaced since
        yield stream


def read_bytes(path: Path, most: int) -> bytes:
    """The content of a regular file of at most `most` bytes.

    Raises
    ------
    ConfigError
        As :func:`open_regular`, or the file grows beyond the limit while it is read.
    """
    return b"".join(read_chunks(path, most))


def read_chunks(path: Path, most: int) -> Iterator[bytes]:
    """As :func:`read_bytes`, in parts of at most 1 MB: for checksums and copies of large files."""
    with open_regular(path, most) as stream:
        total = 0
        while part := _read(path, stream):
            total += len(part)
            if total > most:
                raise _too_large(path, most)
            yield part


def _check(path: Path, status: os.stat_result, most: int) -> None:
    check_regular(path, status)
    if status.st_size > most:
        raise _too_large(path, most)


def _read(path: Path, stream: BinaryIO) -> bytes:
    try:
        return stream.read(_CHUNK)
    except OSError as error:
        raise _unreadable(path, error) from error


def _too_large(path: Path, most: int) -> ConfigError:
    return ConfigError(f"{path}: larger than {most >> 20} MB, the limit for this kind of file. Is it the right file?")


def _unreadable(path: Path, error: Exception) -> ConfigError:
    return ConfigError(f"{path}: cannot be read ({error}). Make it readable, or copy it again")

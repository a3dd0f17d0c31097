"""Hidden places beside a result, in which it grows until it is whole.

Each is locked while its writer lives, so that a later run can tell those that a kill has left, and remove them. Where
locks are not to be had (Windows, some network disks) nothing is removed.
"""

from __future__ import annotations

import glob
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # pragma: no cover
    fcntl = None  # type: ignore[assignment]

MARK = ".partial-"
"""Part of the name of everything that is not whole yet."""
_STEM = 180  # bytes of the result's name in that of its temporary: both must fit 255 bytes


@contextmanager
def hidden(path: Path, folder: bool, leftovers: bool = True) -> Iterator[Path]:
    """A new file or folder beside `path`, of the same suffix, locked; what is left of it at the end is removed.

    Raises
    ------
    OSError
        It cannot be made.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    stem, suffix = (path.name, "") if folder else (path.stem, path.suffix)
    start = f".{shortened(stem)}{MARK}"
    if leftovers:
        _remove_leftovers(path.parent, start, suffix)
    place, lock = path, -1
    try:
        while lock < 0:  # again where another run took it for a leftover before it was locked
            place = path.with_name(f"{start}{secrets.token_hex(4)}{suffix}")
            lock = _make_locked(place, folder)
        yield place
    finally:
        if place != path:
            remove(place)
        if lock >= 0:
            os.close(lock)


def remove(path: Path) -> None:
    """Remove a file, a link, or a folder with what is in it, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def flush(path: Path) -> None:
    """Wait until a file, or a folder and all that is in it, is on the disk itself: a rename may get there before it."""
    if path.is_dir():
        for parent, _, names in os.walk(path):
            for name in names:
                _fsync(os.path.join(parent, name))
            _fsync(parent)
    else:
        _fsync(path)


def flush_name(path: Path) -> None:
    """Wait until the name of `path` is on the disk itself."""
    _fsync(path.parent)


def shortened(stem: str) -> str:
    """The first characters of a name, _STEM bytes of them at most."""
    while len(os.fsencode(stem)) > _STEM:
        stem = stem[:-1]
    return stem


def _make_locked(place: Path, folder: bool) -> int:
    """Descriptor of the new place, which holds its lock; -1 where it was removed before it was locked."""
    if folder:
        place.mkdir()
    else:
        os.close(os.open(place, os.O_CREAT | os.O_EXCL, 0o666))
    if fcntl is None:
        return os.open(os.devnull, os.O_RDONLY)  # Windows renames no open file
    try:
        handle = os.open(place, os.O_RDONLY)
    except FileNotFoundError:
        return -1
    with suppress(OSError):
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    if place.exists():
        return handle
    os.close(handle)
    return -1


def _remove_leftovers(folder: Path, start: str, suffix: str) -> None:
    """Remove temporaries that nobody has locked."""
    if fcntl is None:
        return
    for name in glob.glob(f"{glob.escape(start)}????????{glob.escape(suffix)}", root_dir=folder):
        place = folder / name
        with suppress(OSError):
            handle = os.open(place, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)  # a pipe of that name must not hang
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                remove(place)
            finally:
                os.close(handle)


def _fsync(path: Path | str) -> None:
    with suppress(PermissionError):  # Windows opens no folders
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)

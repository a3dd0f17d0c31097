"""Output folders: a run replaces only what an earlier run wrote.

An output folder contains a list of its own files, MARKER. Only a folder with that list is replaced, and only the files in
the list; all other files in it are kept in the new folder. New and old folder are exchanged atomically where the system
can (Linux: renameat2), so that one of them has the name at any moment, even after a kill.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.reading import kind_of, read_bytes
from rgbd_calib.io.temporary import remove, shortened
from rgbd_calib.io.text import first_few

MARKER = ".rgbd-calib"
_FORMAT = "rgbd-calib/output"
_MAX_BYTES = 256 << 20
"""4 million names."""
_SHOWN = 3
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # <fcntl.h>, <linux/fs.h>


def mark(folder: Path) -> None:
    """Write the list of all that is in `folder` into it; names of folders end in a slash."""
    names = sorted(_names(folder))
    text = json.dumps({"format": _FORMAT, "version": 1, "names": names}, indent=0)
    (folder / MARKER).write_text(text + "\n", encoding="utf-8")


def check_replaceable(folder: Path) -> None:
    """Raise ConfigError unless `folder` is absent, empty, or one that :func:`mark` has marked."""
    if not os.path.lexists(folder):
        return
    if not folder.is_dir():
        raise ConfigError(
            f"{folder}: a folder was expected, {kind_of(folder.lstat().st_mode)} was found. Choose another name"
        )
    if _own_names(folder) is None and (seen := sorted(os.listdir(folder))):
        raise ConfigError(
            f"{folder}: not replaced: a folder that rgbd-calib wrote (with a file {MARKER}) was expected, one with "
            f"{first_few(seen, _SHOWN)} was found. Choose another name, or delete the folder yourself"
        )


def foreign_names(folder: Path) -> list[str]:
    """What is in a marked folder beside the program's own files, sorted; names of folders end in a slash."""
    own = _own_names(folder) or set()
    return sorted(name for name in _names(folder) if name not in own)


def replace_folder(new: Path, old: Path) -> None:
    """Put the marked folder `new` in the place of `old`, which is removed; what is not of this program is kept.

    Raises
    ------
    ConfigError
        `old` was not written by this program, or `new` has a file where `old` has one of somebody else.
    OSError
        The system refuses; `old` is as it was.
    """
    check_replaceable(old)
    _take_over(old, new)
    shutil.copymode(old, new)
    if _exchange(new, old):
        remove(new)
        return
    aside = _aside(old)
    old.replace(aside)
    try:
        new.replace(old)
    except BaseException:
        aside.replace(old)
        raise
    remove(aside)


def restore(folder: Path) -> None:
    """Put back what a kill left aside between the two renames, where the system has no exchange."""
    aside = _aside(folder)
    if os.path.lexists(aside) and not os.path.lexists(folder):
        aside.replace(folder)
    elif aside.is_dir() and _own_names(aside) is not None:
        remove(aside)  # its files, and what it held of others, are in `folder`


def _aside(folder: Path) -> Path:
    stem = shortened(folder.name)
    if stem != folder.name:
        stem += hashlib.sha256(os.fsencode(folder.name)).hexdigest()[:8]
    return folder.with_name(f".{stem}.replaced")


def _own_names(folder: Path) -> set[str] | None:
    """What the marker lists, and itself; None where there is no marker of this program."""
    path = folder / MARKER
    if not os.path.lexists(path):
        return None
    try:
        data = json.loads(read_bytes(path, _MAX_BYTES))
        if data["format"] == _FORMAT and all(isinstance(name, str) for name in data["names"]):
            return {MARKER, *data["names"]}
    except (ConfigError, ValueError, TypeError, LookupError, RecursionError):
        pass
    return None


def _names(folder: Path) -> Iterator[str]:
    """Everything below `folder`, relative to it, with slashes; links are not followed."""
    for parent, folders, files in os.walk(folder):
        at = Path(parent).relative_to(folder)
        for name in folders:
            is_link = os.path.islink(os.path.join(parent, name))
            yield (at / name).as_posix() + ("" if is_link else "/")
        for name in files:
            yield (at / name).as_posix()


def _take_over(old: Path, new: Path) -> None:
    """Give `new` all that `old` holds of others: a second name where the disk allows it, else a copy."""
    for name in foreign_names(old):
        source, target = old / name, new / name
        if name.endswith("/") and target.is_dir() and not target.is_symlink():
            continue
        if os.path.lexists(target) or any(not p.is_dir() for p in _parents(new, target) if os.path.lexists(p)):
            raise ConfigError(
                f"{source}: not written by rgbd-calib, and in the way of a new file. Move it, or choose another name"
            )
        target.parent.mkdir(parents=True, exist_ok=True)
        if name.endswith("/"):
            target.mkdir()
            shutil.copystat(source, target)
            continue
        try:
            os.link(source, target, follow_symlinks=False)
        except OSError:
            if source.is_symlink() or source.is_file():
                shutil.copy2(source, target, follow_symlinks=False)
            else:
                raise


def _parents(top: Path, path: Path) -> Iterator[Path]:
    """The folders between `top` and `path`."""
    return (parent for parent in path.parents if parent != top and top in parent.parents)


def _exchange(a: Path, b: Path) -> bool:
    """Let two names change places in one step; False where the system or the disk cannot."""
    with suppress(OSError, AttributeError, TypeError):  # no such function, or (Windows) no such library
        rename = ctypes.CDLL(None, use_errno=True).renameat2
        return rename(_AT_FDCWD, os.fsencode(a), _AT_FDCWD, os.fsencode(b), _RENAME_EXCHANGE) == 0
    return False

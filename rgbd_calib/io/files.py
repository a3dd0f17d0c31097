"""Files written whole or not at all, and YAML as this project writes it."""

from __future__ import annotations

import errno
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import yaml

from rgbd_calib.errors import ConfigError
from rgbd_calib.io import folders, safe_yaml
from rgbd_calib.io.plain import plain
from rgbd_calib.io.reading import kind_of, read_bytes
from rgbd_calib.io.temporary import MARK, flush, flush_name, hidden
from rgbd_calib.io.text import valid

_ADVICE = {
    errno.ENOSPC: "Free space, or choose another disk",
    errno.EDQUOT: "Free space, or choose another disk",
    errno.EFBIG: "Choose another disk, or raise the limit of a file's size",
    errno.EISDIR: "A folder of that name is in the way: move it, or choose another name",
    errno.ENOTDIR: "A file is in the way: move it, or choose another name",
    errno.EEXIST: "Something of that name is in the way: move it, or choose another name",
    errno.ENOTEMPTY: "A folder of that name is in the way: move it, or choose another name",
    errno.ENAMETOOLONG: "Choose a shorter name",
}


def resolved(path: Path) -> Path:
    """Where `path` is written: a link is written through, not replaced."""
    return Path(os.path.realpath(path)) if os.path.islink(path) else path


@contextmanager
def whole_file(path: Path, durable: bool = True) -> Iterator[Path]:
    """A temporary path beside `path`, with the same suffix, renamed to it at the end, or removed where the body fails.

    Parameters
    ----------
    durable
        At return the file is on the disk itself, and what killed runs have left of it is gone. False for one of many
        in a folder that is written whole.

    Raises
    ------
    ConfigError
        The folder cannot be written to, the disk is full, or the path is not a regular file.
    """
    with _refusals(path):
        target = resolved(path)
        check_output(path)
        with hidden(target, folder=False, leftovers=durable) as temporary:
            yield temporary
            if durable:
                flush(temporary)
            with suppress(FileNotFoundError):  # a new file
                shutil.copymode(target, temporary)
            temporary.replace(target)
            if durable:
                flush_name(target)


@contextmanager
def whole_folder(path: Path, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder beside `path`, renamed to it at the end, or removed where the body fails.

    See :mod:`rgbd_calib.io.folders` for what is replaced.

    Raises
    ------
    ConfigError
        The folder cannot be written to, the disk is full, or something is there that is not to be replaced.
    """
    with _refusals(path):
        target = resolved(path)
        folders.restore(target)
        if overwrite:
            folders.check_replaceable(target)
        with hidden(target, folder=True) as temporary:
            yield temporary
            folders.mark(temporary)
            flush(temporary)
            if overwrite and target.is_dir():
                folders.replace_folder(temporary, target)
            else:
                temporary.replace(target)
            flush_name(target)


def check_output(path: Path) -> None:
    """Raise ConfigError where `path` is no place for a file: a folder, a pipe, a socket or a device is never replaced."""
    with suppress(FileNotFoundError, NotADirectoryError):
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            raise ConfigError(f"{path}: cannot be written, {kind_of(mode)} is in the way. Choose another name")


@contextmanager
def _refusals(path: Path) -> Iterator[None]:
    """What the system refuses while `path` is written becomes an error for people."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        seen = os.fsdecode(error.filename) if isinstance(error.filename, str | bytes) else ""
        own = {path, *path.parents, resolved(path), *resolved(path).parents}
        if seen and MARK not in seen and Path(seen) not in own:
            raise  # of another file, which was read meanwhile
        what = _ADVICE.get(error.errno or 0, "Choose a folder you may write to")
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error}). {what}") from error


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all.

    Raises
    ------
    ConfigError
        As :func:`whole_file`, or the text holds part of a name that is not UTF-8.
    """
    try:
        data = text.encode("utf-8")
    except UnicodeEncodeError as error:
        seen = valid(text[error.start : error.end])
        raise ConfigError(f"{path}: cannot be written as UTF-8, a name holds {seen}. Rename it") from None
    with whole_file(path) as temporary:
        temporary.write_bytes(data)


_Base: type = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


class _Dumper(_Base):  # type: ignore[misc, valid-type]
    def ignore_aliases(self, data: Any) -> bool:
        return True


def _represent_list(dumper: _Dumper, data: list[Any]) -> yaml.Node:
    numbers = all(isinstance(v, int | float) for v in data)
    matrix = bool(data) and all(isinstance(v, list) and all(isinstance(x, int | float) for x in v) for v in data)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=numbers or matrix)


_Dumper.add_representer(list, _represent_list)
_Dumper.add_representer(tuple, lambda dumper, data: _represent_list(dumper, list(data)))


def dump_yaml(data: dict[str, Any]) -> str:
    """YAML text with keys in the given order and matrices in brackets; floats survive the round trip exactly."""
    return yaml.dump(plain(data), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120)


def load_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file; its keys are text.

    Raises
    ------
    ConfigError
        No such file, not YAML (with the line), a key twice, too large, or not a mapping.
    """
    try:
        data = safe_yaml.load(read_bytes(path, safe_yaml.MAX_BYTES).decode("utf-8"))
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: cannot be read as text ({error}). Save it as UTF-8") from error
    except safe_yaml.UnsafeYaml as error:
        raise ConfigError(f"{path}: {error}") from error
    if not isinstance(data, dict):
        raise ConfigError(
            f"{path}: holds {type(data).__name__ if data is not None else 'nothing'}, a mapping is needed"
        )
    return data

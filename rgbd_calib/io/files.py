"""Files written whole or not at all, files read up to a limit, and YAML as this project writes it."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rgbd_calib.errors import ConfigError
from rgbd_calib.io import safe_yaml
from rgbd_calib.io.temporary import MARK, flush, flush_name, hidden, remove

_ADVICE = {
    errno.ENOSPC: "Free space, or choose another disk",
    errno.EDQUOT: "Free space, or choose another disk",
    errno.EFBIG: "Choose another disk, or raise the limit of a file's size",
    errno.EISDIR: "A folder of that name is in the way: move it, or choose another name",
    errno.ENOTDIR: "A file is in the way: move it, or choose another name",
    errno.EEXIST: "Something of that name is in the way: move it, or choose another name",
    errno.ENOTEMPTY: "A folder of that name is in the way: move it, or choose another name",
}


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
        The folder cannot be written to, or the disk is full.
    """
    with _refusals(path), hidden(path, folder=False, leftovers=durable) as temporary:
        yield temporary
        if durable:
            flush(temporary)
        temporary.replace(path)
        if durable:
            flush_name(path)


@contextmanager
def whole_folder(path: Path, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder beside `path`, renamed to it at the end, or removed where the body fails.

    What it replaces is moved aside first, since no rename replaces a folder that is not empty; where a kill came between
    the two, the next run moves it back.

    Raises
    ------
    ConfigError
        The folder cannot be written to, the disk is full, or something is there that is not to be replaced.
    """
    aside = path.with_name(f".{path.name}.replaced")
    with _refusals(path), hidden(path, folder=True) as temporary:
        if os.path.lexists(aside):
            remove(aside) if os.path.lexists(path) else aside.replace(path)
        yield temporary
        flush(temporary)
        if overwrite and os.path.lexists(path):
            path.replace(aside)
        try:
            temporary.replace(path)
        except BaseException:
            if os.path.lexists(aside):
                aside.replace(path)
            raise
        flush_name(path)
        remove(aside)


@contextmanager
def _refusals(path: Path) -> Iterator[None]:
    """What the system refuses while `path` is written becomes an error for people."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        seen = os.fsdecode(error.filename) if isinstance(error.filename, str | bytes) else ""
        if seen and MARK not in seen and Path(seen) not in (path, *path.parents):
            raise  # of another file, which was read meanwhile
        what = _ADVICE.get(error.errno or 0, "Choose a folder you may write to")
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error}). {what}") from error


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_bytes(path: Path, most: int) -> bytes:
    """What is in a file of at most `most` bytes.

    Raises
    ------
    ConfigError
        No such file, one that cannot be read, no regular file (a pipe, a device), or a larger one.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise ConfigError(f"{path}: no regular file seen, one is needed. Save it to a file first")
        with path.open("rb") as stream:
            data = stream.read(most + 1)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:  # ValueError: a name with a null byte
        raise ConfigError(f"{path}: cannot be read ({error}). Make it readable, or copy it again") from error
    if len(data) > most:
        raise ConfigError(f"{path}: larger than {most >> 20} MB seen, no file of this kind is. Is it the right file?")
    return data


class _Dumper(yaml.SafeDumper):
    def ignore_aliases(self, data: Any) -> bool:
        return True


def _represent_list(dumper: _Dumper, data: list[Any]) -> yaml.Node:
    numbers = all(isinstance(v, int | float) for v in data)
    matrix = bool(data) and all(isinstance(v, list) and all(isinstance(x, int | float) for x in v) for v in data)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=numbers or matrix)


_Dumper.add_representer(list, _represent_list)
_Dumper.add_representer(tuple, lambda dumper, data: _represent_list(dumper, list(data)))


def plain(value: Any) -> Any:
    """The same value in YAML's own types: arrays become lists, numpy scalars numbers, paths text."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    return str(value) if isinstance(value, Path) else value


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

"""CSV tables: written whole or not at all, read row by row with the line of everything that is wrong."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.files import whole_file
from rgbd_calib.io.reading import open_regular

MAX_BYTES = 256 << 20
"""4 million corners; 8 cameras that see all of a board of 88 corners in 1,000 frames are 45 MB."""
MAX_NAME = 200
"""Characters of a name: it becomes part of a file's name, which has 255 bytes."""
MAX_LINE = 1 << 20
"""Characters; a row of eight short fields has less than 1,000."""
_LARGEST = {"px": 1e6, "m": 1e6}
_LARGEST_OTHER = 1e18  # microseconds since 1970 are 1.8e15


def write_table(path: Path, header: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """Write a CSV file whole or not at all."""
    with whole_file(path) as temporary:
        fill_table(temporary, header, rows)


def fill_table(path: Path, header: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """Write a CSV file in place: for a temporary of :func:`rgbd_calib.io.files.whole_file`."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)


def read_table(
    path: Path, columns: tuple[str, ...], optional: tuple[str, ...] = ()
) -> Iterator[tuple[int, dict[str, str]]]:
    """Rows of a CSV file with their line numbers; it must have these columns, each once, and may have the optional ones;
    others pass, and are not given.

    Raises
    ------
    ConfigError
        While it is read: no CSV, a column that is missing or there twice, a row of another length, or too large a file.
    """
    try:
        with (
            open_regular(path, MAX_BYTES) as stream,
            io.TextIOWrapper(stream, encoding="utf-8-sig", newline="") as text,
        ):
            reader = csv.reader(_lines(path, text), strict=True)
            header = next(reader, [])
            columns = (*columns, *(column for column in optional if column in header))
            places = [_place(path, header, column) for column in columns]
            for row in reader:
                if not row:
                    continue
                if len(row) != len(header):
                    raise ConfigError(
                        f"{path}: line {reader.line_num}: {len(header)} fields needed, {len(row)} seen. Is the file whole?"
                    )
                yield reader.line_num, {column: row[i] for column, i in zip(columns, places, strict=True)}
    except (OSError, ValueError, csv.Error) as error:  # ValueError: not UTF-8
        raise ConfigError(f"{path}: cannot be read as CSV ({error}). Save it as comma-separated UTF-8") from error


def _lines(path: Path, text: io.TextIOWrapper) -> Iterator[str]:
    """The lines of a table that has its whole length from the start: one that is being filled might have no end."""
    left = os.fstat(text.fileno()).st_size
    while line := text.readline(MAX_LINE):
        left -= len(line)  # characters, of one byte or more
        if left < 0:
            raise ConfigError(f"{path}: grows while it is read. Wait until it is complete")
        if len(line) == MAX_LINE:
            raise ConfigError(f"{path}: a line of {MAX_LINE >> 20} million characters seen. Is it the right file?")
        yield line


def number(path: Path, line: int, key: str, text: str) -> float:
    """A finite number of a CSV file, or an error that names the line and the column."""
    try:
        if "_" in text or not text.isascii():
            raise ValueError  # float() reads 1_000 and ١ as well, which other programs do not
        value = float(text)
    except ValueError:
        raise ConfigError(f"{path}: line {line}: {key}: {short(text)} seen, a number needed. Correct it") from None
    largest = _LARGEST.get(key.rpartition("_")[2], _LARGEST_OTHER)
    if not abs(value) <= largest:
        raise ConfigError(
            f"{path}: line {line}: {key}: {short(text)} seen, a finite number of {largest:g} at most needed. Correct it, "
            "or take the row out"
        )
    return value


def number_or_nan(path: Path, line: int, key: str, text: str) -> float:
    """A finite number, or NaN where the field is empty."""
    return number(path, line, key, text) if text.strip() else math.nan


def whole_number(path: Path, line: int, key: str, text: str) -> int:
    """A whole number from 0 to 10^9."""
    value = number(path, line, key, text)
    if not (0 <= value <= 1e9 and value == int(value)):
        raise ConfigError(
            f"{path}: line {line}: {key}: {short(text)} seen, a whole number from 0 on needed. Correct it"
        )
    return int(value)


def name(path: Path, line: int, key: str, text: str) -> str:
    """A name that stands in other files too: not empty, and nothing but printable characters."""
    if not text or len(text) > MAX_NAME or not text.isprintable():
        raise ConfigError(
            f"{path}: line {line}: {key}: {short(text)} seen, 1 to {MAX_NAME} printable characters needed. Rename it"
        )
    return text


def short(value: Any) -> str:
    """What was seen, on one line and not too long."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _place(path: Path, header: list[str], column: str) -> int:
    if header.count(column) == 1:
        return header.index(column)
    what = "is there twice" if column in header else "is missing"
    seen = ", ".join(header)
    seen = "nothing" if not seen else seen if seen.isprintable() and len(seen) < 200 else short(seen)
    raise ConfigError(
        f"{path}: line 1: column '{column}' {what}; seen: {seen}. Each is needed once: correct the header"
    )

"""Numbers in the names of image files: which digits are one number, and what time a name says."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from datetime import datetime, timezone
from decimal import Decimal

_DATE = (
    r"(?:19|20)\d\d[-_]?[01]\d[-_]?[0-3]\d[-_T ]?[0-2]\d[-_.]?[0-5]\d[-_.]?[0-5]\d(?:[-_.]\d{3}(?:\d{3}){0,2})?(?!\d)"
)
_EPOCH = r"1\d{9}(?:[-_]\d{6,9}|\.\d{1,9})(?!\d)"
_DECIMAL = r"(?<![A-Za-z.])\d+\.\d{3,}(?!\d|\.\d)"
NUMBER = re.compile(rf"(?<!\d)(?:{_DATE}|{_EPOCH}|{_DECIMAL})|\d+")
"""A number in a path. A date with its time, seconds with nanoseconds, and a decimal are one: 20240501_123000_123, 1305031102.175304."""
_EPOCH_UNITS_US = {13: Decimal(1000), 16: Decimal(1), 19: Decimal("0.001")}
"""Microseconds for each unit of a whole number of so many digits: Unix time in ms, us, ns."""


def order(name: str) -> tuple[list[str | int], str]:
    """By which names of frames are sorted: 2 before 10, as they were filmed."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)], name


def spelled_anew(names: Iterable[str]) -> bool:
    """Names that are whole numbers, one of them in two ways: 1 and 0001."""
    spelled = set(names)
    return all(map(str.isdecimal, spelled)) and len(set(map(int, spelled))) < len(spelled)


def times_us(names: Sequence[str]) -> list[int] | None:
    """Times that names of frames say, microseconds; None where they are not all times."""
    out = [_time_us(name) for name in names]
    return None if None in out or not out else [time_us for time_us in out if time_us is not None]


def _time_us(name: str) -> int | None:
    if name.isdecimal() and len(name) in _EPOCH_UNITS_US and not re.fullmatch(_DATE, name):
        return round(int(name) * _EPOCH_UNITS_US[len(name)])
    if re.fullmatch(_DATE, name):
        digits = re.sub(r"\D", "", name)
        try:
            whole = datetime.strptime(digits[:14], "%Y%m%d%H%M%S").replace(tzinfo=timezone.utc)
        except ValueError:
            return None
        return int(whole.timestamp()) * 1_000_000 + round(Decimal(f"0.{digits[14:] or 0}") * 1_000_000)
    if re.fullmatch(_EPOCH, name):
        seconds, fraction = re.split(r"[-_.]", name)
        separated = "." in name or len(fraction) == 6
        # seconds_nanoseconds without zeros in front, as ROS prints them, are not told from microseconds otherwise
        value = Decimal(f"{seconds}.{fraction}") if separated else Decimal(seconds) + Decimal(fraction) / 10**9
        return round(value * 1_000_000)
    if re.fullmatch(_DECIMAL, name):
        return round(Decimal(name) * 1_000_000)
    return None

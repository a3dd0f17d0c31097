"""What records of a rig file share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from typing import Any, TypeVar


@dataclass(frozen=True, slots=True)
class Record:
    """A part of a rig file: fields that equal their default are not written."""

    other: Mapping[str, Any] = field(default_factory=dict, kw_only=True)
    """Keys that this program does not know; written back as they are."""


R = TypeVar("R", bound=Record)


def overlaid(under: R, over: R) -> R:
    """`under` with what `over` states."""
    own = {f.name: getattr(over, f.name) for f in fields(over) if f.default_factory is MISSING}
    return replace(under, **{name: value for name, value in own.items() if value is not None})

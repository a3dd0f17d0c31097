"""What records of a rig file share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class Record:
    """A part of a rig file: fields that equal their default are not written."""

    other: Mapping[str, Any] = field(default_factory=dict, kw_only=True)
    """Keys that this program does not know; written back as they are."""

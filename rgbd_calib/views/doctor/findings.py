"""What is wrong with a recording, as sentences with the remedy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from rgbd_calib.io.text import first_few

Kind = Literal[
    "damaged", "missing", "unsynchronised", "blurred", "moved", "depth late", "not the board", "not found", "no depth",
    "covered", "overexposed", "underexposed", "not joined", "coverage", "not read", "not registered",
    "depth unit",
    "colour planes",
]  # fmt: skip


@dataclass(frozen=True)
class RecordingFinding:
    """One thing to mend."""

    kind: Kind
    cameras: tuple[str, ...]
    frames: tuple[str, ...]
    """Empty where it is about whole cameras."""
    matters: bool
    """False: advice; a calibration can do without."""
    sentence: str
    """Which camera, what was seen, what to do."""


def listed(frames: Sequence[str]) -> str:
    """Frames in words: `frame 000003`, `frames 000001, 000002 and 5 more`."""
    return f"frame{'s' if len(frames) > 1 else ''} {first_few(frames)}"

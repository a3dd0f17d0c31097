"""What the checks of a result say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from rgbd_calib.quality.record import Record

Level = Literal["caution", "distrust"]


@dataclass(frozen=True, slots=True)
class Finding(Record):
    """Something is not as the model says."""

    check: str
    level: Level
    cameras: tuple[str, ...]
    text: str
    """What is seen, and what that means."""
    advice: str
    effect_mm: float | None = None
    p: float | None = None
    """Chance of it where all is well, in one test."""


@dataclass(frozen=True, slots=True)
class BoardScaleEstimate(Record):
    """How much longer the board's squares are by the depth than stated: distances as such are known no better."""

    percent: float
    sd_percent: float
    distance_m: float
    """Usual distance of the boards."""


@dataclass(frozen=True, slots=True)
class ScoreOutcome(Record):
    """The test of one hypothesis, of one camera where it is about one."""

    test: str
    camera: str | None
    chi2: float | None = None
    dof: int | None = None
    p: float | None = None
    effect_mm: float | None = None


@dataclass(frozen=True, slots=True)
class HeldOutPart(Record):
    """The test of a part of the recording against the rest."""

    frames: str
    chi2: float | None = None
    dof: int | None = None
    others: float | None = None
    p: float | None = None
    moves_mm: float | None = None


@dataclass(frozen=True, slots=True)
class SelfCheck(Record):
    """The outcome of all checks of a result."""

    trusted: bool
    findings: tuple[Finding, ...]
    """Those that matter most first."""
    scale: BoardScaleEstimate | None = None
    tests: tuple[ScoreOutcome, ...] | None = None
    tested: int | None = None
    held_out: tuple[HeldOutPart, ...] | None = None
    noise_of_parts: Mapping[str, float] | None = None
    """Of each part of a camera's residuals, over that of the whole."""

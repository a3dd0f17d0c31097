"""How far apart cameras put the same points: expected by the covariance, and measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.quality.joint import JointErrors
from rgbd_calib.quality.record import Record


class Counted(Enum):
    """The errors that an expected alignment counts."""

    ALL = "poses, intrinsics, depth bias"
    POSES = "poses alone; intrinsics and depth taken as exact"


@dataclass(frozen=True, slots=True)
class ExpectedPair(Record):
    """Expected alignment of two cameras."""

    points: int
    mean_mm: float
    worst_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedGrid(Record):
    """Expected alignment over the working volume."""

    points_in_reference_m: FloatArray
    """(n, 3), in the reference camera's frame, so that they hold in any world."""
    error_mm: FloatArray
    """(n,), mean over the pairs of cameras that see the point."""


@dataclass(frozen=True, slots=True)
class ExpectedAlignment(Record):
    """How far apart two cameras are expected to put the same point, by the covariance of all parameters."""

    of: Counted
    mean_mm: float
    p95_mm: float
    worst_mm: float
    pairs: Mapping[str, ExpectedPair]
    grid: ExpectedGrid | None = None
    joint: JointErrors | None = None
    """What it is expected by; None where there are too many parameters to keep."""

    @property
    def lower_bound(self) -> bool:
        """Not all errors are counted."""
        return self.of is Counted.POSES


@dataclass(frozen=True, slots=True)
class AlignmentNumbers(Record):
    """Distances between where two cameras put the same points, and errors of boards that one locates and the other sees."""

    points: int
    mean_mm: float | None = None
    median_mm: float | None = None
    p95_mm: float | None = None
    median_px: float | None = None
    mean_px: float | None = None
    median_board_mm: float | None = None
    """Of the errors in px, at the board, across the line of sight."""
    expected_mm: float | None = None
    """Mean that the rig's own covariance expects at the same points."""


@dataclass(frozen=True, slots=True)
class PoseNumbers(Record):
    """Error of a camera's pose against the truth."""

    rotation_deg: float
    translation_mm: float
    relative_translation: float


@dataclass(frozen=True, slots=True)
class MeasuredAlignment(Record):
    """Alignment by a recording, or against the truth; by pair of cameras and by distance."""

    all: AlignmentNumbers
    pairs: Mapping[str, AlignmentNumbers]
    by_distance: Mapping[str, AlignmentNumbers]
    poses: Mapping[str, PoseNumbers] | None = None

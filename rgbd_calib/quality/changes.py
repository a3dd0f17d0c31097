"""What was done to a finished rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rgbd_calib.quality.alignment import AlignmentNumbers
from rgbd_calib.quality.record import Record


@dataclass(frozen=True, slots=True)
class FloorFit(Record):
    """The floor that is the world."""

    frames: tuple[str, ...]
    points: int
    rms_m: float
    reference_height_m: float


@dataclass(frozen=True, slots=True)
class CameraUpdate(Record):
    """A camera of a finished rig that was posed anew, or added, by a board or by a snapshot."""

    camera: str
    by: str | None = None
    was_in_rig: bool | None = None
    recording: str | None = None
    recording_sha256: str | None = None
    snapshot: str | None = None
    snapshot_sha256: str | None = None
    intrinsics: str | None = None
    views: int | None = None
    common_frames: Mapping[str, int] | None = None
    left_out: Mapping[str, str] | None = None
    alignment: Mapping[str, AlignmentNumbers] | None = None
    moved_mm: float | None = None
    turned_deg: float | None = None
    unchanged_share: float | None = None

"""What a simulation's truth has beside its cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.quality.record import Record


@dataclass(frozen=True, slots=True, eq=False)
class TrueWall(Record):
    """The plane normal . p = normal_z distance_m in the colour camera's frame, of a simulation."""

    distance_m: float
    normal: FloatArray


@dataclass(frozen=True, slots=True)
class TrueChange(Record):
    """What changed between two simulated snapshots."""

    T_old_new: Mapping[str, FloatArray]
    moved: tuple[str, ...]
    changed_share: Mapping[str, float]
    light: float
    depth_scale: float
    depth_offset_m: float

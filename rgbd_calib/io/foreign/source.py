"""What every reader of foreign recordings offers, and which of its pictures belong to one instant."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from rgbd_calib.geometry.camera import Intrinsics

Kind = Literal["color", "depth"]
Stamps = Mapping[Kind, Sequence[int]]
"""Times of a camera's pictures in the order in which the source delivers them, us."""

DEFAULT_PERIOD_US = 33_333


@dataclass(frozen=True)
class Picture:
    """Picture number `index` of one stream."""

    camera: str
    kind: Kind
    index: int
    pixels: np.ndarray
    """Colour (h, w, 3) uint8, B G R; depth (h, w) uint16, 0 = none."""


class Source(Protocol):
    """A foreign recording of one or more cameras that share a clock."""

    name: str
    depth_scale: float
    """Metres for each unit of depth."""
    remarks: tuple[str, ...]
    """What the user should know, such as that registration is unknown."""
    intrinsics: Mapping[str, Intrinsics]
    """Of the cameras that the recording describes."""

    def stamps(self) -> Mapping[str, Stamps]:
        """Times of all pictures by camera."""
        ...

    def pictures(self) -> Iterator[Picture]:
        """All pictures, each stream in the order of its stamps."""
        ...


@dataclass(frozen=True)
class Plan:
    """Which pictures make which frame."""

    frames: list[dict[tuple[str, Kind], int]] = field(default_factory=list)
    """For each frame, in order of time: {(camera, kind): index of the picture}."""
    lone_depth: dict[str, int] = field(default_factory=dict)
    """{camera: depth pictures without a colour picture}: a frame needs colour."""
    lone_color: dict[str, int] = field(default_factory=dict)
    """{camera: colour pictures without depth}: written without it."""


def plan_frames(stamps: Mapping[str, Stamps]) -> Plan:
    """Pair colour and depth of each camera, then join what several cameras took at the same time.

    Colour and depth belong together where each is the other's nearest within half a period; pictures of different
    cameras where they lie within half a period.
    """
    plan = Plan()
    colors: list[tuple[int, str, int]] = []
    partners: dict[tuple[str, int], int] = {}
    half_us = min((_period_us(s["color"]) for s in stamps.values() if s.get("color")), default=DEFAULT_PERIOD_US) / 2
    for camera, streams in stamps.items():
        color_us, depth_us = list(streams.get("color", ())), list(streams.get("depth", ()))
        pairs = pair_nearest(color_us, depth_us, _period_us(color_us) / 2)
        partners.update({(camera, c): d for c, d in pairs.items()})
        plan.lone_depth[camera] = len(depth_us) - len(pairs)
        plan.lone_color[camera] = len(color_us) - len(pairs)
        colors += [(t, camera, i) for i, t in enumerate(color_us)]
    start_us = 0
    for time_us, camera, index in sorted(colors):
        if not plan.frames or time_us - start_us > half_us or (camera, "color") in plan.frames[-1]:
            plan.frames.append({})
            start_us = time_us
        plan.frames[-1][camera, "color"] = index
        if (camera, index) in partners:
            plan.frames[-1][camera, "depth"] = partners[camera, index]
    return plan


def pair_nearest(color_us: Sequence[int], depth_us: Sequence[int], tolerance_us: float) -> dict[int, int]:
    """{index of colour: index of depth} where each is the other's nearest, within the tolerance."""

    def nearest(time_us: int, order: list[int], times: Sequence[int]) -> int:
        at = bisect_left(order, time_us, key=lambda i: times[i])
        return min(order[max(0, at - 1) : at + 1], key=lambda i: abs(times[i] - time_us))

    if not color_us or not depth_us:
        return {}
    by_color = sorted(range(len(color_us)), key=lambda i: color_us[i])
    by_depth = sorted(range(len(depth_us)), key=lambda i: depth_us[i])
    pairs = {}
    for c, time_us in enumerate(color_us):
        d = nearest(time_us, by_depth, depth_us)
        if abs(depth_us[d] - time_us) <= tolerance_us and nearest(depth_us[d], by_color, color_us) == c:
            pairs[c] = d
    return pairs


def _period_us(times_us: Sequence[int]) -> float:
    if len(times_us) < 3:
        return DEFAULT_PERIOD_US
    return float(np.median(np.diff(np.sort(np.asarray(times_us, np.int64)))))

"""Which pictures of foreign recordings belong to one instant."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeVar

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.foreign.source import Kind, Source, Stamps, Stems

Match = Literal["auto", "stem", "timestamp", "order"]
"""What makes pictures one instant: what the source has; equal names; near times; their number in the stream."""
T = TypeVar("T")
DEFAULT_PERIOD_US = 33_333
Frame = dict[tuple[str, Kind], int]
"""{(camera, kind): index of the picture}."""


@dataclass(frozen=True)
class Plan:
    """Which pictures make which frame."""

    frames: list[Frame] = field(default_factory=list)
    """In order."""
    names: list[str] | None = None
    """Of the frames; None: they are numbered."""
    lone_depth: dict[str, int] = field(default_factory=dict)
    """{camera: depth pictures without a colour picture}: a frame needs colour."""
    lone_color: dict[str, int] = field(default_factory=dict)
    """{camera: colour pictures without depth}: written without it."""


def plan_of(sources: Sequence[Source], match: Match, kinds: Sequence[Kind]) -> Plan:
    """Which pictures of sources that were filmed together make which frame; of these kinds only.

    Raises
    ------
    ConfigError
        A source has no times, or no names, that this match needs.
    """
    stems = [source.stems() for source in sources]
    by_name = match in ("stem", "order") or (
        match == "auto" and any(own is not None and not s.by_time for own, s in zip(stems, sources, strict=True))
    )
    if not by_name:
        stamps = {c: _only(own, kinds) for source in sources for c, own in source.stamps().items()}
        for source in sources:
            lacking = [c for c in source.cameras if not stamps.get(c, {}).get("color")]
            if lacking and match == "timestamp":
                raise ConfigError(
                    f"{source.name}: {', '.join(lacking)}: no timestamps in it. Join frames by name or by order: --match stem, "
                    "--match order"
                )
        return plan_frames(stamps)
    named: dict[str, Stems] = {}
    for source, own in zip(sources, stems, strict=True):
        if own is None and match != "order":
            raise ConfigError(
                f"{source.name}: its pictures have times, and no names to join them by. Choose --match timestamp or --match order"
            )
        named.update({c: _only(streams, kinds) for c, streams in (source.stamps() if own is None else own).items()})  # type: ignore[arg-type, misc]
    return plan_by_names(by_order(named) if match == "order" else named)


def plan_frames(stamps: Mapping[str, Stamps], tolerance_us: float | None = None) -> Plan:
    """Pair colour, depth and infrared of each camera, then join what several cameras took at the same time.

    Pictures belong together where each is the other's nearest within half a period, or the tolerance; pictures of different
    cameras where they lie within it.
    """
    plan = Plan()
    colors: list[tuple[int, str, int]] = []
    partners: dict[tuple[str, int], Frame] = {}
    periods = {camera: _period_us(streams) for camera, streams in stamps.items()}
    half_us = tolerance_us or min(periods.values(), default=DEFAULT_PERIOD_US) / 2
    for camera, streams in stamps.items():
        color_us, depth_us = list(streams.get("color", ())), list(streams.get("depth", ()))
        pairs = pair_nearest(color_us, depth_us, tolerance_us or periods[camera] / 2)
        infrared = pair_nearest(color_us, list(streams.get("ir", ())), tolerance_us or periods[camera] / 2)
        for kind, found in (("depth", pairs), ("ir", infrared)):
            for c, other in found.items():
                partners.setdefault((camera, c), {})[camera, kind] = other  # type: ignore[index]
        plan.lone_depth[camera] = len(depth_us) - len(pairs)
        plan.lone_color[camera] = len(color_us) - len(pairs)
        colors += [(t, camera, i) for i, t in enumerate(color_us)]
    start_us = 0
    for time_us, camera, index in sorted(colors):
        if not plan.frames or time_us - start_us > half_us or (camera, "color") in plan.frames[-1]:
            plan.frames.append({})
            start_us = time_us
        plan.frames[-1][camera, "color"] = index
        plan.frames[-1].update(partners.get((camera, index), {}))
    return plan


def plan_by_names(stems: Mapping[str, Stems]) -> Plan:
    """Join pictures of equal names; depth goes with colour, or with infrared where a frame has no colour."""
    frames: dict[str, Frame] = {}
    plan = Plan(names=[])
    for camera, streams in stems.items():
        index: dict[Kind, dict[str, int]] = {k: {s: i for i, s in enumerate(names)} for k, names in streams.items()}
        color, depth, infrared = (index.get(kind, {}) for kind in ("color", "depth", "ir"))  # type: ignore[call-overload]
        plan.lone_depth[camera] = sum(stem not in color and stem not in infrared for stem in depth)
        plan.lone_color[camera] = sum(stem not in depth for stem in color)
        for kind, own in index.items():
            for stem, i in own.items():
                if stem in color or stem in infrared:
                    frames.setdefault(stem, {})[camera, kind] = i
    names = sorted(frames, key=_in_order)
    return Plan([frames[name] for name in names], names, plan.lone_depth, plan.lone_color)


def by_order(streams: Mapping[str, Mapping[Kind, Sequence[object]]]) -> dict[str, dict[Kind, list[str]]]:
    """Names by number: the first picture of each stream is one instant, and so on."""
    return {
        camera: {kind: [f"{i:06d}" for i in range(len(own))] for kind, own in of_camera.items()}
        for camera, of_camera in streams.items()
    }


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


def _period_us(streams: Stamps) -> float:
    """Of a camera: its colour's, or that of another stream where there are few colour pictures."""
    for kind in ("color", "depth", "ir"):
        times_us = streams.get(kind, ())  # type: ignore[call-overload]
        if len(times_us) >= 3:
            return float(np.median(np.diff(np.sort(np.asarray(times_us, np.int64)))))
    return DEFAULT_PERIOD_US


def _in_order(name: str) -> tuple[int, str]:
    """Names that are numbers by their value: 2 before 10."""
    return (int(name), name) if name.isdigit() and len(name) < 30 else (0, name)


def _only(streams: Mapping[Kind, T], kinds: Sequence[Kind]) -> dict[Kind, T]:
    return {kind: own for kind, own in streams.items() if kind in kinds}

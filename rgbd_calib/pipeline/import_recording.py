"""Foreign recordings to the dataset format: every frame, paired by time."""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.files import whole_folder
from rgbd_calib.io.foreign.source import Kind, Picture, Plan, Source, Stamps, plan_frames
from rgbd_calib.io.growing_recording import CameraImages, GrowingRecording
from rgbd_calib.io.schema_base import check_name
from rgbd_calib.io.tables import short
from rgbd_calib.types import Board


@dataclass(frozen=True)
class ImportResult:
    """What was written."""

    frames: int
    color: dict[str, int]
    """{camera: colour images}."""
    depth: dict[str, int]
    left_out: dict[str, int]
    """{camera: depth pictures without a colour picture near them}."""


def import_recording(
    sources: Sequence[Source],
    out: Path,
    *,
    board: Board | None = None,
    synchronous: bool = False,
    color_only: bool = False,
    overwrite: bool = False,
) -> ImportResult:
    """Write all frames of `sources` into the recording `out`, whole or not at all.

    Each source has a clock of its own: its frames are instants of its own, unless `synchronous` says that all clocks
    started together.

    Raises
    ------
    ConfigError
        Two sources give a camera of the same name, or depth of different units.
    CalibrationError
        No frames.
    """
    stamps = [_without_depth(source.stamps()) if color_only else source.stamps() for source in sources]
    _check_cameras(sources, stamps)
    intrinsics: dict[str, Intrinsics] = {}
    for source in sources:
        intrinsics.update(source.intrinsics)
    groups = [list(range(len(sources)))] if synchronous else [[i] for i in range(len(sources))]
    result = ImportResult(0, {}, {}, {})
    sizes = {camera: (lens.width, lens.height) for camera, lens in intrinsics.items()}
    with whole_folder(out, overwrite) as folder:
        recording = GrowingRecording(folder, board, depth_scale=sources[0].depth_scale)
        recording.describe(intrinsics)
        for group in groups:
            merged = {camera: s for i in group for camera, s in stamps[i].items()}
            plan = plan_frames(merged)
            _write([sources[i] for i in group], merged, plan, recording, result, sizes)
            result.left_out.update({c: n for c, n in plan.lone_depth.items() if n})
        if recording.finished == 0:
            raise CalibrationError(f"{', '.join(s.name for s in sources)}: no colour frame in it; nothing was written")
    return ImportResult(recording.finished, result.color, result.depth, result.left_out)


def _write(
    sources: Sequence[Source],
    stamps: Mapping[str, Stamps],
    plan: Plan,
    recording: GrowingRecording,
    result: ImportResult,
    sizes: dict[str, tuple[int, int]],
) -> None:
    """Hold each picture until all of its frame are there, then write the frame."""
    frame_of = {(*stream, index): n for n, frame in enumerate(plan.frames) for stream, index in frame.items()}
    names = [recording.reserve() for _ in plan.frames]
    zero_us = min((t for streams in stamps.values() for times in streams.values() for t in times), default=0)
    waiting: dict[int, dict[tuple[str, Kind], Picture]] = {}

    def time_of(picture: Picture) -> int:
        times_us = stamps[picture.camera].get(picture.kind)
        return times_us[picture.index] if times_us and picture.index < len(times_us) else 0

    in_time = heapq.merge(*(s.pictures() for s in sources), key=time_of)
    for picture in in_time:
        n = frame_of.get((picture.camera, picture.kind, picture.index))
        if n is None:
            continue
        there = waiting.setdefault(n, {})
        there[picture.camera, picture.kind] = picture
        if len(there) == len(plan.frames[n]):
            images = _images(waiting.pop(n), stamps, zero_us, result)
            _check_sizes(images, sizes)
            recording.add(names[n], images)
    if waiting:
        raise CalibrationError(
            f"{', '.join(s.name for s in sources)}: {len(waiting)} frames ended too early. Is it whole?"
        )


def _images(
    pictures: Mapping[tuple[str, Kind], Picture], stamps: Mapping[str, Stamps], zero_us: int, result: ImportResult
) -> dict[str, CameraImages]:
    images = {}
    for camera in sorted({camera for camera, _ in pictures}):
        color, depth = pictures[camera, "color"], pictures.get((camera, "depth"))
        if depth is not None and depth.pixels.shape != color.pixels.shape[:2]:
            raise ConfigError(
                f"{camera}: depth has {depth.pixels.shape[1]}x{depth.pixels.shape[0]} px, colour "
                f"{color.pixels.shape[1]}x{color.pixels.shape[0]}; registered depth has colour's size. Choose the registered "
                "topic, or import colour alone (--color-only)"
            )
        images[camera] = CameraImages(
            color.pixels,
            depth.pixels if depth else None,
            stamps[camera]["color"][color.index] - zero_us,
            stamps[camera]["depth"][depth.index] - zero_us if depth else None,
        )
        result.color[camera] = result.color.get(camera, 0) + 1
        result.depth[camera] = result.depth.get(camera, 0) + (depth is not None)
    return images


def _check_sizes(images: Mapping[str, CameraImages], sizes: dict[str, tuple[int, int]]) -> None:
    """Raise ConfigError for an image of another size than those before, or than the intrinsics; `sizes` are kept."""
    for camera, shot in images.items():
        height, width = shot.color.shape[:2]
        if sizes.setdefault(camera, (width, height)) != (width, height):
            raise ConfigError(
                f"{camera}: an image of {width}x{height} px seen, the camera has {sizes[camera][0]}x{sizes[camera][1]}; one size "
                "is needed. Choose the topic that fits camera_info, or split the recording"
            )


def _without_depth(stamps: Mapping[str, Stamps]) -> dict[str, Stamps]:
    return {camera: {"color": streams["color"]} for camera, streams in stamps.items()}


def _check_cameras(sources: Sequence[Source], stamps: Sequence[Mapping[str, Stamps]]) -> None:
    seen: dict[str, str] = {}
    for source, of_source in zip(sources, stamps, strict=True):
        for camera in of_source:
            try:
                check_name(camera)
            except ValueError as error:
                raise ConfigError(
                    f"{source.name}: camera {short(camera)} seen; {error}. Name it: --topics, ID=FILE"
                ) from None
            if camera in seen:
                raise ConfigError(f"{source.name}: camera {camera} is in {seen[camera]} too. Name them: ID=FILE")
            seen[camera] = source.name
        if source.depth_scale != sources[0].depth_scale:
            raise ConfigError(
                f"{source.name}: {source.depth_scale} m a unit of depth, {sources[0].name} has {sources[0].depth_scale}. "
                "Import them one by one"
            )

"""Foreign recordings to the dataset format: every picture, joined to frames by time, by name or by order."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from rgbd_calib.errors import CalibrationError, ConfigError, RgbdCalibError
from rgbd_calib.io.files import whole_folder
from rgbd_calib.io.foreign.folder_writer import MARK, ImportFolder, Unfinished
from rgbd_calib.io.foreign.plan import Match, Plan, plan_of
from rgbd_calib.io.foreign.source import Encoded, Kind, Source, SourceImage, Stamps
from rgbd_calib.io.images import decode_image
from rgbd_calib.io.layout import KINDS
from rgbd_calib.io.recording import write_dataset
from rgbd_calib.io.schema_base import check_name
from rgbd_calib.io.tables import MAX_NAME, short, write_table
from rgbd_calib.pipeline.detection import Progress, silent
from rgbd_calib.pipeline.import_cameras import UNIT_REMEDY, Ask, CameraOptions, describe_cameras

Key = tuple[str, Kind, int]
"""A picture: camera, kind, and its number in the stream."""


@dataclass(frozen=True)
class ImportOptions:
    """How pictures become a recording."""

    cameras: CameraOptions = field(default_factory=CameraOptions)
    match: Match = "auto"
    synchronous: bool = False
    """The clocks of all sources started together, or equal names of all of them are one instant."""
    color_only: bool = False
    overwrite: bool = False


@dataclass(frozen=True)
class ImportResult:
    """What was written."""

    frames: int
    counts: dict[str, dict[Kind, int]]
    """{camera: {kind: images}}."""
    left_out: dict[str, int]
    """{camera: depth pictures without a colour picture near them}."""
    resumed: int
    """Images that an earlier import had written."""
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Group:
    """Sources of one clock, and what is taken of them."""

    sources: tuple[Source, ...]
    plan: Plan
    names: tuple[str, ...]
    """Of the frames."""

    def targets(self) -> dict[Key, str]:
        """Name of its frame for each picture that is taken."""
        return {
            (*stream, index): name
            for frame, name in zip(self.plan.frames, self.names, strict=True)
            for stream, index in frame.items()
        }


def nobody(question: str) -> float | None:
    """There is nobody to ask."""
    return None


def import_recording(
    sources: Sequence[Source],
    out: Path,
    options: ImportOptions | None = None,
    ask: Ask = nobody,
    progress: Progress = silent,
) -> ImportResult:
    """Write all frames of `sources` into the recording `out`, whole or not at all.

    Each source has a clock of its own, unless it says otherwise or `synchronous` does: its frames are instants of its own.
    An import that was interrupted, or for which the disk was too small, goes on where it stopped.

    Raises
    ------
    ConfigError
        Two sources give a camera of the same name; a damaged picture; a unit of depth that nobody knows.
    CalibrationError
        No frames, or the disk is full.
    """
    options = options or ImportOptions()
    _check_cameras(sources)
    kinds: tuple[Kind, ...] = ("color",) if options.color_only else KINDS
    groups, remarks = _groups(sources, options, kinds)
    if not any(group.names for group in groups):
        raise CalibrationError(f"{', '.join(s.name for s in sources)}: no colour frame in it; nothing was written")
    own = _with_unit(groups, options.cameras, ask)
    folder = ImportFolder(out, {"sources": [s.name for s in sources], "plan": _digest(groups)})
    try:
        for group in groups:
            _write(group, folder, progress)
        folder.finish()
        said = {name: camera for source in sources for name, camera in source.cameras.items()}
        cameras, told = describe_cameras(folder.path, said, own, ask, progress)
        for group in groups:
            _write_times(group, folder.path)
        write_dataset(folder.path, cameras, options.cameras.board)
        (folder.path / MARK).unlink()
        with whole_folder(out, options.overwrite) as temporary:
            folder.path.replace(temporary)
    except Unfinished:
        raise
    except RgbdCalibError:
        folder.close()
        shutil.rmtree(folder.path, ignore_errors=True)
        raise
    finally:
        folder.close()
    counts: dict[str, dict[Kind, int]] = {camera: dict.fromkeys(KINDS, 0) for camera in cameras}
    for camera, kind, _ in (key for group in groups for key in group.targets()):
        counts[camera][kind] += 1
    left_out = {c: n for group in groups for c, n in group.plan.lone_depth.items() if n}
    n = len({name for group in groups for name in group.names})
    return ImportResult(n, counts, left_out, folder.resumed, (*remarks, *told))


def _groups(sources: Sequence[Source], options: ImportOptions, kinds: Sequence[Kind]) -> tuple[list[_Group], list[str]]:
    """Sources that share a clock, each group with its plan; frames of a lone group keep the names that they have."""
    together: dict[object, list[Source]] = {}
    for i, source in enumerate(sources):
        clock: object = source.clock if source.clock is not None else i
        together.setdefault("all" if options.synchronous or options.match != "auto" else clock, []).append(source)
    plans = [(tuple(own), plan_of(own, options.match, kinds)) for own in together.values()]
    remarks: list[str] = []
    if len(plans) > 1:
        remarks.append(
            f"{len(plans)} recordings with clocks of their own: none of their frames are one instant. If they were filmed "
            "together, give --synchronous, or --match timestamp, stem or order"
        )
    for source in sources:
        for camera, streams in (source.stems() or source.stamps()).items():
            empty = [kind for kind, pictures in streams.items() if kind in kinds and not pictures]
            if empty:
                remarks.append(f"{source.name}: {camera}: no picture of {', '.join(empty)} in it. Was it cut short?")
    groups: list[_Group] = []
    total = 0
    for own, plan in plans:
        names = _kept(plan.names) if len(plans) == 1 else None
        groups.append(_Group(own, plan, names or tuple(f"{total + i:06d}" for i in range(len(plan.frames)))))
        total += len(plan.frames)
    return groups, remarks


def _kept(names: Sequence[str] | None) -> tuple[str, ...] | None:
    """Names that become names of frames: numbers of equal length, so that they sort; None where they cannot be files."""
    if names is None or any(not name.isprintable() or name.startswith(".") or len(name) > MAX_NAME for name in names):
        return None
    width = max(map(len, names), default=0)
    padded = tuple(name.zfill(width) for name in names) if all(name.isdigit() for name in names) else tuple(names)
    return padded if len(set(padded)) == len(padded) else tuple(names)


def _write(group: _Group, folder: ImportFolder, progress: Progress) -> None:
    """Write what is taken of a group, and is not there yet."""
    targets = {key: name for key, name in group.targets().items() if not folder.has(key[0], key[1], name)}
    for source in group.sources:
        own = {key: name for key, name in targets.items() if key[0] in source.cameras}
        if not own:
            continue
        left = dict(own)

        def pictures(source: Source = source, own: Mapping[Key, str] = own) -> Iterator[SourceImage]:
            yield from source.pictures(lambda camera, kind, index: (camera, kind, index) in own)

        for picture in progress(pictures(), len(own), f"Importing {Path(source.name).name}"):
            key = (picture.camera, picture.kind, picture.index)
            where = f"{source.name}: {picture.camera}: {picture.kind} {picture.index}"
            folder.put(picture.camera, picture.kind, left.pop(key), picture.pixels, where)
        if left:
            raise CalibrationError(
                f"{source.name}: {len(left)} of {len(own)} pictures are missing (as {next(iter(left))[1]} "
                f"{next(iter(left))[2]} of {next(iter(left))[0]}). Is it whole? Copy it again"
            )


def _write_times(group: _Group, folder: Path) -> None:
    """timestamps.csv of each camera whose pictures have times, from the first of the group on."""
    stamps: dict[str, Stamps] = {c: own for source in group.sources for c, own in source.stamps().items()}
    zero_us = min((t for own in stamps.values() for times in own.values() for t in times), default=0)
    rows: dict[str, list[list[object]]] = {}
    for frame, name in zip(group.plan.frames, group.names, strict=True):
        for camera in sorted({camera for camera, _ in frame}):
            times = [_time(stamps.get(camera, {}), frame, camera, kind) for kind in ("color", "depth")]
            if any(t is not None for t in times):
                rows.setdefault(camera, []).append([name, *("" if t is None else t - zero_us for t in times)])
    for camera, own in rows.items():
        write_table(folder / camera / "timestamps.csv", ("frame", "color_us", "depth_us"), own)


def _time(stamps: Stamps, frame: Mapping[tuple[str, Kind], int], camera: str, kind: Kind) -> int | None:
    index, times = frame.get((camera, kind)), stamps.get(kind, ())
    return None if index is None or index >= len(times) else times[index]


def _with_unit(groups: Sequence[_Group], options: CameraOptions, ask: Ask) -> CameraOptions:
    """The options with the unit of depth asked for, where nothing will tell it; before the long work."""
    if options.depth_scale is not None or options.board is not None:
        return options
    for group in groups:
        for source in group.sources:
            for camera, own in source.cameras.items():
                first = next((f[camera, "depth"] for f in group.plan.frames if (camera, "depth") in f), None)
                if first is None or own.depth_scale is not None or _is_float(source, camera, first):
                    continue
                answer = ask(f"{source.name}: {camera}: metres for each unit of depth")
                if answer is None:
                    raise ConfigError(
                        f"{source.name}: {camera}: nothing in it says the unit of its depth. {UNIT_REMEDY}"
                    )
                return replace(options, depth_scale=answer)
    return options


def _is_float(source: Source, camera: str, index: int) -> bool:
    picture = next(source.pictures(lambda c, kind, i: (c, kind, i) == (camera, "depth", index)), None)
    if picture is None:
        return False
    pixels = picture.pixels
    array = decode_image(pixels.data, f"{source.name}: {camera}") if isinstance(pixels, Encoded) else pixels
    return array.dtype.kind == "f"


def _digest(groups: Sequence[_Group]) -> str:
    """Of everything that decides which picture is written under which name."""
    total = hashlib.sha256()
    for group in groups:
        for source in group.sources:
            state = Path(source.name).stat()
            total.update(repr((source.name, state.st_size, state.st_mtime_ns)).encode())
        total.update(repr((group.names, [sorted(f.items()) for f in group.plan.frames])).encode())
    return total.hexdigest()


def _check_cameras(sources: Sequence[Source]) -> None:
    seen: dict[str, str] = {}
    for source in sources:
        for camera in source.cameras:
            try:
                check_name(camera)
            except ValueError as error:
                raise ConfigError(
                    f"{source.name}: camera {short(camera)} seen; {error}. Name it: --topics, ID=FILE"
                ) from None
            if camera in seen:
                raise ConfigError(f"{source.name}: camera {camera} is in {seen[camera]} too. Name them: ID=FILE")
            seen[camera] = source.name

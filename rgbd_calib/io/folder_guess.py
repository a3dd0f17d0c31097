"""The layout of a folder of images that nobody described: which files are whose colour, depth or infrared images.

Names are compared: the run of digits that differs most from file to file numbers the frames, words say colour, depth or
infrared where the pixels do not, and what is left of the path and differs between streams names the camera.
"""

from __future__ import annotations

import re
import shlex
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.camera_names import CAMERA, FRAME, TOKENS, name_cameras
from rgbd_calib.io.frame_names import NUMBER, order
from rgbd_calib.io.images import DEPTH_SUFFIXES, SUFFIXES
from rgbd_calib.io.layout import (
    KINDS,
    FilePatterns,
    Kind,
    braced,
    camera_names,
    describe_unused,
    find_files,
    is_text,
    walk,
)
from rgbd_calib.io.schema_base import check_name
from rgbd_calib.io.sniff import Sniffed, sniff

_CAMERA_WORDS = (
    "c",
    "cam",
    "camera",
    "k",
    "kinect",
    "dev",
    "device",
    "sensor",
    "view",
    "cn",
    "rs",
    "azure",
    "n",
    "node",
)
_DEPTH_WORDS = ("depth", "dpt", "range", "tof", "z16", "disparity")
_IR_WORDS = ("ir", "infra", "infrared", "nir", "amplitude")
_OTHER_WORDS = ("mask", "label", "seg", "normal", "conf", "confidence", "vis", "colormap", "preview", "points", "cloud")
ARCHIVES = (".zip", ".7z", ".rar", ".tar", ".tgz", ".gz", ".xz", ".bz2", ".zst")
_IMPORTED = (".mp4", ".m4v", ".avi", ".mov", ".mkv", ".webm", ".bag", ".db3", ".mcap", ".oni", ".npz", ".exr")
"""What `import` reads and `init` does not."""
_ANY = ("color", "grey 8", "grey 16", "float")
_ONTO_WORDS = ("to", "2", "into", "onto", "in")
_REGISTERED_WORDS = ("align", "aligned", "regist", "registered", "warped", "transformed", "reg")


@dataclass(frozen=True)
class Stream:
    """Files of one kind of one camera."""

    template: str
    """The path of its files with {frame} in it."""
    files: Mapping[str, str]
    """Path, relative to the folder, by frame."""
    sniffed: Sniffed

    @property
    def words(self) -> set[str]:
        return {token.lower() for token in TOKENS.findall(self.template)}

    @property
    def is_depth(self) -> bool:
        return any(word.startswith(_DEPTH_WORDS) and not onto for word, onto in self._onto())

    @property
    def is_onto_depth(self) -> bool:
        """Colour in the geometry of depth: color_to_depth."""
        return any(word.startswith(_DEPTH_WORDS) and onto for word, onto in self._onto())

    def _onto(self) -> list[tuple[str, bool]]:
        """Each word, and whether it is what another kind is aligned to."""
        words = [token.lower() for token in TOKENS.findall(self.template) if token.isalnum()]
        return [(word, before in _ONTO_WORDS) for before, word in zip(["", *words], words, strict=False)]

    @property
    def is_other(self) -> bool:
        return any(word.startswith(_OTHER_WORDS) for word in self.words)


@dataclass(frozen=True)
class Guess:
    """The streams of a folder, by kind and camera."""

    streams: Mapping[Kind, Mapping[str, Stream]]
    patterns: FilePatterns
    remarks: tuple[str, ...] = ()

    @property
    def cameras(self) -> tuple[str, ...]:
        return tuple(self.streams["color"])

    def is_standard(self, root: Path) -> bool:
        """Without patterns, as CAM/color/STEM.png and the like, these files are found, and no others."""
        found = find_files(root, self.cameras, None)
        return all(
            {frame: path.relative_to(root).as_posix() for frame, path in own.items()}
            == (dict(self.streams[kind][camera].files) if camera in self.streams[kind] else {})
            for kind, of_kind in found.items()
            for camera, own in of_kind.items()
        )


def guess_layout(
    root: Path,
    given: Mapping[Kind, str] | None = None,
    more: tuple[str, ...] = (),
    look: Callable[[Path], Sniffed | None] | None = None,
    color_only: bool = False,
) -> Guess:
    """Look at the names and headers of all images in a folder.

    Parameters
    ----------
    given
        Patterns that are known, by kind; the others are guessed. With `color` given, nothing is guessed.
    color_only
        Pictures of depth are left out, where they are otherwise refused.
    more
        Suffixes of images besides those that recordings read.
    look
        Type and size of an image file; by default that of :func:`rgbd_calib.io.sniff.sniff`.

    Raises
    ------
    ConfigError
        No colour images, or names that do not tell which camera is which: says what was seen.
    """
    if given and "color" in given:
        return _given(root, given, look or sniff)
    best: Guess | None = None
    failed: ConfigError | None = None
    for mode in ("whole", "first", "last"):  # of names with two numbers for each frame
        try:
            streams, remarks = find_streams(root, mode, more, look or sniff)
            guess = _assign(root, *_as_given(root, streams, remarks, given or {}), color_only)
        except ConfigError as error:
            failed = failed or error
            continue
        if best is None or _coinciding(guess) > _coinciding(best):
            best = guess
    if best is None:
        raise failed or ConfigError(f"{root}: no images in it")
    return best


def _coinciding(guess: Guess) -> int:
    depth = guess.streams["depth"]
    return sum(len(set(s.files) & set(depth[c].files)) for c, s in guess.streams["color"].items() if c in depth)


_ONE_FORMAT = {".jpeg": ".jpg", ".tif": ".tiff"}
"""Suffixes of one format, whose files make one stream."""


def names_coincide(guess: Guess) -> bool:
    """Whether half of the frames of a stream, at least, have the name of a frame that they belong to.

    Of depth and infrared against their camera's colour, and of each camera against the others.
    """
    color = {name: set(stream.files) for name, stream in guess.streams["color"].items()}
    pairs = [(set(s.files), color[c]) for kind in ("depth", "ir") for c, s in guess.streams[kind].items()]
    for name, own in color.items():
        others = [frames for other, frames in color.items() if other != name]
        pairs += [(own, set().union(*others))] if others else []
    return all(2 * len(a & b) >= min(len(a), len(b)) for a, b in pairs)


def find_streams(
    root: Path, mode: str, more: tuple[str, ...], look: Callable[[Path], Sniffed | None]
) -> tuple[list[Stream], list[str]]:
    """Every set of files that differ by their frame alone, and what was left out."""
    shapes: dict[str, list[str]] = defaultdict(list)
    for path in walk(root):
        if Path(path).suffix.lower() in (*SUFFIXES, *DEPTH_SUFFIXES, *more):
            suffix = Path(path).suffix.lower()
            shapes[NUMBER.sub("#", path.rpartition(".")[0]) + _ONE_FORMAT.get(suffix, suffix)].append(path)
    for shape in [s for s, paths in shapes.items() if len(paths) == 1 and "#" not in s.rpartition("/")[2]]:
        folder = shapes[shape][0].rpartition("/")[0]  # names without numbers: all of the folder
        shapes[f"{folder}/*{Path(shape).suffix}"] += shapes.pop(shape)
    found: dict[str, dict[str, str]] = defaultdict(dict)
    for paths in shapes.values():
        several = len({Path(path).suffix for path in paths}) > 1  # IMG_1.JPG beside IMG_2.jpg
        for template, frame, path in _numbered(paths, mode):
            found[f"{template.rpartition('.')[0]}.*" if several else template][frame] = path
    streams, remarks = [], []
    for template, files in sorted(found.items()):
        files = dict(sorted(files.items(), key=lambda item: order(item[0])))
        seen = {files[frame]: look(root / files[frame]) for frame in _some(list(files))}
        looks, unread = set(seen.values()), [path for path, kind in seen.items() if kind is None]
        one = next(iter(looks))
        if len(looks) == 1 and one is not None:
            streams.append(Stream(template, files, one))
        else:
            why = "images of several kinds or sizes"
            if looks == {None} and template.endswith(".npz"):
                why = "of .npz, files of one array each are read"
            elif unread:
                why = "no images that can be read" if looks == {None} else f"{', '.join(unread[:3])} cannot be read"
            remarks.append(f"{len(files)} files {template} are not used ({why})")
    return streams, remarks


def _some(frames: list[str]) -> list[str]:
    return [frames[i] for i in sorted({0, len(frames) // 2, len(frames) - 1})]


def _numbered(paths: Sequence[str], mode: str) -> list[tuple[str, str, str]]:
    """(template, frame, path) of paths that are equal but for their numbers."""
    runs = [list(NUMBER.finditer(path)) for path in paths]
    suffix_at = [path.rindex(".") for path in paths]
    runs = [[r for r in own if r.end() <= at] for own, at in zip(runs, suffix_at, strict=True)]
    if len({len(own) for own in runs}) > 1 or not runs[0] or (len(paths) == 1 and "/" in paths[0][runs[0][-1].end() :]):
        return [_whole_stem(path) for path in paths]
    columns = list(range(len(runs[0])))
    values = {c: [own[c].group() for own in runs] for c in columns}

    def rank(c: int) -> tuple[bool, int, bool, int]:
        before = re.search(r"([A-Za-z]*)[^A-Za-z\d]?$", paths[0][: runs[0][c].start()])
        like_camera = before is not None and before[1].lower() in _CAMERA_WORDS
        in_name = "/" not in paths[0][runs[0][c].end() :]
        return not like_camera or len(paths) == 1, len(set(values[c])), in_name, c

    chosen = max(columns, key=rank)
    if not rank(chosen)[0] and len(columns) == 1:
        return [_whole_stem(path) for path in paths]  # one image of each camera
    same = [c for c in columns if len(set(zip(values[c], values[chosen], strict=True))) == len(set(values[chosen]))]
    twins = [c for c in same if len(set(values[c])) == len(set(values[chosen]))]
    out = []
    for path, own in zip(paths, runs, strict=True):
        # several numbers in one name that count the same frames: `000001-33366699.jpg`
        beside = [
            c
            for c in twins
            if "/" not in path[min(own[c].start(), own[chosen].start()) : max(own[c].end(), own[chosen].end())]
        ]
        if mode == "whole":
            spans = [(min(own[c].start() for c in beside), max(own[c].end() for c in beside))]
            loose = []
        else:
            at = own[beside[0 if mode == "first" else -1]]
            spans, loose = [at.span()], [own[c].span() for c in beside if own[c].span() != at.span()]
        frame = path[slice(*spans[0])]
        spans += [own[c].span() for c in columns if c not in beside and own[c].group() == frame and c in twins]
        pieces = sorted([(s, FRAME) for s in spans] + [(s, "*") for s in loose])
        out.append((_replaced(path, pieces), frame, path))
    return out


def _whole_stem(path: str) -> tuple[str, str, str]:
    folder, slash, name = path.rpartition("/")
    stem, dot, suffix = name.rpartition(".")
    return f"{braced(folder)}{slash}{FRAME}{dot}{braced(suffix)}", stem, path


def _replaced(path: str, pieces: Sequence[tuple[tuple[int, int], str]]) -> str:
    out, at = "", 0
    for (start, end), text in pieces:
        out += braced(path[at:start]) + text
        at = end
    return out + braced(path[at:])


def _as_given(
    root: Path, streams: Sequence[Stream], remarks: Sequence[str], given: Mapping[Kind, str]
) -> tuple[list[Stream], list[str]]:
    """The streams, of a kind whose pattern is given those that fit it, and what was left out."""
    kept, told = list(streams), list(remarks)
    for kind, text in given.items():
        names = camera_names(text, walk(root)) if CAMERA in text else ["C1"]
        found = FilePatterns(text).find(root, names)["color"].values()
        fits = {path.relative_to(root).as_posix() for own in found for path in own.values()}
        if not fits:
            raise ConfigError(f"{root}: no file is named as --{kind} {text}. Correct the pattern")
        left = [s for s in kept if kind_of(s, True) == kind and not fits & set(s.files.values())]
        kept = [s for s in kept if s not in left]
        told += [f"{len(s.files)} files {s.template} are not used ({_looks(s)})" for s in left]
    return kept, told


def _assign(root: Path, streams: Sequence[Stream], remarks: Sequence[str], color_only: bool = False) -> Guess:
    """Which stream is which kind of which camera."""
    by_kind: dict[Kind, list[Stream]] = {kind: [] for kind in KINDS}
    left: list[Stream] = []
    colored = any(s.sniffed.pixels == "color" and not s.is_depth and not s.is_other for s in streams)
    for stream in streams:
        its_kind = kind_of(stream, colored)
        (left if its_kind is None else by_kind[its_kind]).append(stream)
    if raw := [s for s in by_kind["color"] if not s.is_onto_depth]:  # resampled colour is used where there is no other
        left += [s for s in by_kind["color"] if s.is_onto_depth]
        by_kind["color"] = raw
    if not by_kind["color"]:
        seen = "; ".join([f"{s.template} ({len(s.files)}, {_looks(s)})" for s in streams[:6]] + [*remarks[:3]])
        rest = [path for path in walk(root) if Path(path).suffix.lower() not in (*SUFFIXES, *DEPTH_SUFFIXES)]
        unread = describe_unused([path for path in rest if not is_text(path)] or ([] if seen else rest))
        seen = "; ".join(filter(None, [seen, unread])) or "no images"
        remedy = _other_way(root, rest) or f"Name them: --color PATTERN, with {CAMERA} and {FRAME} in it"
        raise ConfigError(f"{root}: no colour images found; seen: {seen}. {remedy}")
    if not color_only and not by_kind["depth"] and (drawn := [s for s in left if s.is_depth and not s.is_other]):
        raise ConfigError(
            f"{root}: depth of 16 bits or floating point expected, {drawn[0].template} of 8 bits a pixel seen: pictures of depth hold no "
            f"measurements. Record depth as 16-bit PNG; or calibrate colour alone: --color PATTERN, with {CAMERA} and {FRAME} in it"
        )
    for kind in ("depth", "ir"):
        by_kind[kind], others = _preferred(by_kind[kind])
        left += others
    named = name_cameras(root, {kind: [s.template for s in own] for kind, own in by_kind.items()})
    found = {kind: dict(zip(named[kind][0], by_kind[kind], strict=True)) for kind in KINDS}
    texts = [named[kind][1] for kind in KINDS]
    unused = [f"{len(s.files)} files {s.template} are not used ({_looks(s)})" for s in left]
    return Guess(found, FilePatterns(texts[0] or "", texts[1], texts[2]), (*remarks, *unused))


def _other_way(root: Path, paths: Sequence[str]) -> str:
    """What to do about a folder of no images, by the suffixes of what is in it; empty where nothing is known."""
    suffixes = {Path(path).suffix.lower(): path for path in paths}
    packed = next((suffixes[s] for s in ARCHIVES if s in suffixes), None)
    if packed is not None:
        return f"Unpack {packed}, and give the folder that comes out of it"
    if suffixes.keys() & {*_IMPORTED}:
        return f"Import them: rgbd-calib import {shlex.quote(str(root))} -o RECORDING"
    return ""


def kind_of(stream: Stream, colored: bool) -> Kind | None:
    pixels = stream.sniffed.pixels
    if stream.is_other:
        return None
    infrared = bool(stream.words & set(_IR_WORDS))
    if pixels in ("grey 16", "float"):
        return "ir" if infrared else "depth"
    if stream.is_depth:
        return None  # a picture of depth
    if infrared:
        return "ir"
    named = bool(stream.words & {"color", "colour", "rgb"})  # one grey camera beside coloured ones
    return "color" if pixels == "color" or named or not colored else None


def _preferred(streams: list[Stream]) -> tuple[list[Stream], list[Stream]]:
    """Of depth in two versions, the registered one; and those that are left."""
    named = [s for s in streams if any(w.startswith(_REGISTERED_WORDS) for w in s.words)]
    if named and len(named) < len(streams) and len(streams) % len(named) == 0:
        return named, [s for s in streams if s not in named]
    return streams, []


def _looks(stream: Stream) -> str:
    return f"{stream.sniffed.width}x{stream.sniffed.height} px, {stream.sniffed.pixels}"


def _given(root: Path, given: Mapping[Kind, str], look: Callable[[Path], Sniffed | None]) -> Guess:
    """Streams by patterns that the user gives; the cameras are what stands for {camera}."""
    patterns = FilePatterns(given["color"], given.get("depth"), given.get("ir"))
    cameras = camera_names(given["color"], walk(root)) if CAMERA in given["color"] else ["C1"]
    try:
        patterns.check(cameras)
        for name in cameras:
            check_name(name)
    except ValueError as error:
        raise ConfigError(f"--color {given['color']}: {error}") from None
    if not cameras:
        raise ConfigError(f"{root}: no file is named as --color {given['color']}. Correct the pattern")
    found = patterns.find(root, cameras)
    streams: dict[Kind, dict[str, Stream]] = {kind: {} for kind in KINDS}
    for kind, of_kind in found.items():
        for camera, files in of_kind.items():
            if files:
                relative = {frame: path.relative_to(root).as_posix() for frame, path in files.items()}
                looks = look(next(iter(files.values())))
                if looks is None:
                    raise ConfigError(f"{next(iter(files.values()))}: no image that can be read. Correct --{kind}")
                fits = looks.pixels in (
                    ("grey 16", "float") if kind == "depth" else ("color", "grey 8") if kind == "color" else _ANY
                )
                if not fits:
                    needed = "16 bits or floating point" if kind == "depth" else "8 bits a channel"
                    raise ConfigError(
                        f"{next(iter(files.values()))}: {needed} expected for --{kind}, {looks.pixels} seen. Correct the pattern"
                    )
                text = patterns.by_kind()[kind] or ""
                streams[kind][camera] = Stream(text.replace(CAMERA, braced(camera)), relative, looks)
    return Guess(streams, patterns)

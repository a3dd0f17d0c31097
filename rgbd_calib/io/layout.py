"""Where the images of a recording lie, and which of its files nobody reads."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Literal

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.frame_names import order
from rgbd_calib.io.images import DEPTH_SUFFIXES, SUFFIXES

Kind = Literal["color", "depth", "ir"]
KINDS: tuple[Kind, ...] = ("color", "depth", "ir")
Files = dict[str, dict[str, Path]]
"""Paths by camera and frame, frames in order."""
_SUFFIXES: dict[Kind, tuple[str, ...]] = {"color": SUFFIXES, "depth": DEPTH_SUFFIXES, "ir": SUFFIXES}
_TABLES = ("timestamps.csv", "distances.csv")
_TEXTS = (".yaml", ".yml", ".json", ".txt", ".csv", ".md", ".xml", ".toml", ".html", ".pdf", ".log", ".py", ".sh")
"""Files that people keep beside images, and that are not counted where images may lie anywhere."""
_DEEPEST = 8
_FIELD = re.compile(r"\{\{|\}\}|\{(\w*)\}")
"""A field, or a brace of a name, written twice."""


@dataclass(frozen=True)
class FilePatterns:
    """Paths in a recording with {camera} and {frame} in them, each as often as one likes, and * for anything but /; {{ and }}
    are braces of a name."""

    color: str
    depth: str | None = None
    ir: str | None = None

    def by_kind(self) -> dict[Kind, str | None]:
        return {"color": self.color, "depth": self.depth, "ir": self.ir}

    def check(self, cameras: Sequence[str]) -> None:
        """Raise ValueError for a pattern that cannot name the images of these cameras, or leads out of the recording."""
        for kind, text in self.by_kind().items():
            if text is None:
                continue
            path, fields = PurePosixPath(text), {field[1] for field in _FIELD.finditer(text)} - {None}
            if path.is_absolute() or ".." in path.parts or "\\" in text or PureWindowsPath(text).drive:
                raise ValueError(f"files.{kind}: a path inside the recording with / between its parts is needed")
            if not text.isprintable() or fields - {"camera", "frame"} or not closed(text):
                raise ValueError(
                    f"files.{kind}: {{camera}} and {{frame}} are all that a pattern may have in braces; braces of a name are "
                    "written twice, as {{1}}"
                )
            if "frame" not in fields or ("camera" not in fields and len(cameras) > 1):
                lacks = "frame" if "frame" not in fields else "camera"
                raise ValueError(f"files.{kind}: {{{lacks}}} is missing; as rgb_{{camera}}_{{frame}}.jpg")

    def find(self, root: Path, cameras: Sequence[str]) -> dict[Kind, Files]:
        """The files of each kind.

        Raises
        ------
        ConfigError
            Two files are the same image.
        """
        found: dict[Kind, Files] = {kind: {camera: {} for camera in cameras} for kind in KINDS}
        compiled = {kind: _compile(text, cameras) for kind, text in self.by_kind().items() if text is not None}
        for relative in walk(root):
            for kind, pattern in compiled.items():
                match = pattern.fullmatch(relative)
                if match:
                    camera = match.groupdict().get("camera", cameras[0])
                    _add(found[kind][camera], match["frame"], root / relative)
        return {
            kind: {c: dict(sorted(own.items(), key=lambda item: order(item[0]))) for c, own in files.items()}
            for kind, files in found.items()
        }


def find_files(root: Path, cameras: Sequence[str], patterns: FilePatterns | None) -> dict[Kind, Files]:
    """The images of a recording by kind: by patterns, or CAM/color/STEM.png and the like.

    Raises
    ------
    ConfigError
        Two files are the same image, or a name cannot be shown.
    """
    if patterns is not None:
        return patterns.find(root, cameras)
    return {kind: {c: _images(root / c / kind, _SUFFIXES[kind]) for c in cameras} for kind in KINDS}


def is_text(path: str) -> bool:
    """A file that describes images, by its suffix."""
    return Path(path).suffix.lower() in _TEXTS


def find_unused(
    root: Path, cameras: Sequence[str], patterns: FilePatterns | None, files: Mapping[Kind, Files]
) -> tuple[str, ...]:
    """Paths, relative to the recording, of files under a camera that nobody reads: neither taken, nor of a taken frame.

    A depth image without a colour or infrared image of its frame counts as well, and so does a whole folder of images beside those of
    the cameras.
    """
    taken = {f"{camera}/{table}" for camera in cameras for table in _TABLES}
    for kind, of_kind in files.items():
        for camera, own in of_kind.items():
            partners = {*files["color"][camera], *files["ir"][camera]}
            some = own if kind != "depth" else {f: path for f, path in own.items() if f in partners}
            taken |= {path.relative_to(root).as_posix() for path in some.values()}
    unused = []
    for relative in walk(root):
        inside = patterns is None and relative.partition("/")[0] in cameras and "/" in relative
        text = is_text(relative) or (patterns is None and "/" not in relative)
        if relative not in taken and (inside or not text):
            unused.append(relative)
    return tuple(unused)


def others(root: Path, taken: Collection[str]) -> str:
    """Files under a foreign folder that are neither taken nor texts, in words; empty where there are none."""
    left = [path for path in walk(root) if path not in taken and not is_text(path)]
    return f"{root}: not used: {describe_unused(left)}" if left else ""


def describe_unused(unused: Sequence[str]) -> str:
    """The files in words, by folder and type: `12 .tiff in C1/Depth (as 000000.tiff)`."""
    counts: Counter[tuple[str, str]] = Counter()
    first: dict[tuple[str, str], str] = {}
    for relative in unused:
        folder, _, name = relative.rpartition("/")
        key = (folder, Path(name).suffix.lower())
        counts[key] += 1
        first.setdefault(key, name)
    parts = [
        f"{n} {suffix or 'without suffix'} in {folder or '.'} (as {first[folder, suffix]})"
        for (folder, suffix), n in counts.most_common(4)
    ]
    left = len(unused) - sum(n for _, n in counts.most_common(4))
    return ", ".join([*parts, *([f"and {left} more"] if left else [])])


def camera_names(pattern: str, paths: Iterable[str]) -> list[str]:
    """What stands for {camera} in the paths that are as a pattern says, in order."""
    text = _compile(pattern, ()).pattern.replace("(?P<camera>)", "(?P<camera>[^/]+?)")
    return sorted({match["camera"] for path in paths if (match := re.fullmatch(text, path))})


def walk(root: Path) -> Iterator[str]:
    """Paths, relative to `root` and with / in them, of all files that are not hidden, in order; links are followed once."""
    seen: set[tuple[int, int]] = set()

    def inside(folder: Path, prefix: str, depth: int) -> Iterator[str]:
        try:
            state = folder.stat()
            entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
        except OSError:
            return
        if (state.st_dev, state.st_ino) in seen or depth > _DEEPEST:
            return
        seen.add((state.st_dev, state.st_ino))
        for entry in entries:
            if entry.name.startswith("."):
                continue
            if entry.is_dir():
                yield from inside(Path(entry.path), f"{prefix}{entry.name}/", depth + 1)
            else:
                yield prefix + entry.name

    yield from inside(root, "", 0)


def _compile(text: str, cameras: Sequence[str]) -> re.Pattern[str]:
    """A pattern as an expression with the groups camera (where it has one) and frame."""
    names = "|".join(re.escape(c) for c in sorted(cameras, key=len, reverse=True))
    groups = {"camera": f"(?P<camera>{names})", "frame": "(?P<frame>[^/]+?)"}
    parts, at = [], 0
    for field in _FIELD.finditer(text):
        name = field[1]
        parts += [_literal(text[at : field.start()]), groups[name] if name else re.escape(field[0][0])]
        if name:
            groups[name] = f"(?P={name})"
        at = field.end()
    last = _literal(text[at:])
    if text.endswith(".*"):  # a suffix has no dot in it: 0.1234.png is frame 0.1234
        last = last.removesuffix("[^/]*") + "[^/.]*"
    return re.compile("".join([*parts, last]))


def braced(text: str) -> str:
    """A part of a path as a pattern has it."""
    return text.replace("{", "{{").replace("}", "}}")


def unbraced(text: str) -> str:
    """A part of a path that a pattern has so."""
    return text.replace("{{", "{").replace("}}", "}")


def is_plain(text: str) -> bool:
    """Is there no field in a part of a pattern?"""
    return not set("{}") & set(re.sub(r"\{\{|\}\}", "", text))


def closed(text: str) -> bool:
    """Is each brace of a pattern a field's, or written twice?"""
    return not set("{}") & set(_FIELD.sub("", text))


def _literal(text: str) -> str:
    return "[^/]*".join(re.escape(part) for part in text.split("*"))


def _images(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """Files by stem, in order. A folder or a file may be a link out of the recording: whoever made it meant it."""
    if not folder.is_dir():
        return {}
    found: dict[str, Path] = {}
    images = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and not p.name.startswith(".")]
    for path in sorted(images, key=lambda p: order(p.name)):
        _add(found, path.stem, path)
    return found


def _add(found: dict[str, Path], frame: str, path: Path) -> None:
    if not frame.isprintable():
        raise ConfigError(f"{path.parent}: file {path.name!r} seen, printable characters needed. Rename it")
    if frame in found:
        raise ConfigError(
            f"{path.parent}: {found[frame].name} and {path.name} seen, one image a frame needed. Delete one, or move it"
        )
    found[frame] = path

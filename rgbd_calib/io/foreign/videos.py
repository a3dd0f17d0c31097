"""Videos: one file of colour for each camera, and beside it depth as 16-bit images or as a video of 16-bit pixels.

Frames are numbered from 0 in a video; depth images whose names are numbers have those of the video's frames (from 0 or 1),
others are joined by their order. Videos of several cameras are taken to have started together.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.camera_names import TOKENS, name_cameras
from rgbd_calib.io.folder_guess import Stream, find_streams, kind_of
from rgbd_calib.io.foreign.pictures import SUFFIXES as PICTURE_SUFFIXES
from rgbd_calib.io.foreign.pictures import read_picture, sniff_picture
from rgbd_calib.io.foreign.source import Kind, Source, SourceCamera, SourceImage, Stems, Wanted
from rgbd_calib.io.foreign.video_file import open_video, video_faults
from rgbd_calib.io.images import DEPTH_SUFFIXES
from rgbd_calib.io.images import SUFFIXES as IMAGE_SUFFIXES
from rgbd_calib.io.layout import others, walk
from rgbd_calib.io.schema_base import MAX_SIDE

SUFFIXES = (".mp4", ".m4v", ".avi", ".mov", ".mkv", ".webm")
_MAX_FRAMES = 10_000_000
_IMAGES = (*IMAGE_SUFFIXES, *DEPTH_SUFFIXES, *PICTURE_SUFFIXES)


def has_videos(path: Path) -> bool:
    """True for a video file, or a folder with one anywhere in it."""
    if path.is_file():
        return path.suffix.lower() in SUFFIXES
    return any(Path(relative).suffix.lower() in SUFFIXES for relative in walk(path))


class Videos(Source):
    """The cameras of a folder of videos, or of one file.

    Parameters
    ----------
    camera
        The name of an only camera.
    """

    def __init__(self, path: Path, camera: str) -> None:
        self.name = str(path)
        remarks: list[str] = []
        root = path if path.is_dir() else path.parent
        found = [p for p in walk(root) if Path(p).suffix.lower() in SUFFIXES] if path.is_dir() else [path.name]
        self._videos: dict[Kind, dict[str, Video]] = {"color": {}, "depth": {}, "ir": {}}
        videos = {relative: Video(root / relative) for relative in found}
        by_kind: dict[Kind, list[str]] = {"color": [], "depth": [], "ir": []}
        for relative, video in videos.items():
            kind = _kind(relative, video)
            if kind is None:
                remarks.append(f"{path}: {relative} is not used: a video of 8 bits is a picture of depth, not depth")
            else:
                by_kind[kind].append(relative)
        if not by_kind["color"]:
            raise ConfigError(f"{path}: no colour video in it ({', '.join(found)[:200]} seen). Add it")
        streams: dict[str, Stream] = {}
        if path.is_dir():
            listed, left = find_streams(root, "whole", PICTURE_SUFFIXES, sniff_picture)
            remarks += [f"{path}: {text}" for text in left]
            for stream in listed:
                its_kind = kind_of(stream, True)
                if its_kind in ("depth", "ir"):
                    streams[stream.template] = stream
                    by_kind[its_kind].append(stream.template)
                else:
                    remarks.append(
                        f"{path}: {len(stream.files)} files {stream.template} are not used: the video is colour"
                    )
        named = name_cameras(root, by_kind)
        alone = len(by_kind["color"]) == 1
        self._images: dict[Kind, dict[str, Stream]] = {"color": {}, "depth": {}, "ir": {}}
        self._root = root
        for kind, templates in by_kind.items():
            for name, template in zip(named[kind][0], templates, strict=True):
                name = camera if alone else name
                if template in streams:
                    self._images[kind][name] = streams[template]
                else:
                    self._videos[kind][name] = videos[template]
        self.cameras = {name: SourceCamera() for name in self._videos["color"]}
        counts = {name: video.frames for name, video in self._videos["color"].items()}
        if len(set(counts.values())) > 1:
            text = ", ".join(f"{name} {n}" for name, n in counts.items())
            remarks.append(
                f"{path}: videos of different lengths ({text} frames): frames of equal number are taken as one instant"
            )
        if path.is_dir():
            images = {file for file in walk(root) if Path(file).suffix.lower() in _IMAGES}  # named above
            if rest := others(root, {*found, *images}):
                remarks.append(rest)
        self.remarks = tuple(remarks)

    def stems(self) -> Mapping[str, Stems]:
        out: dict[str, dict[Kind, list[str]]] = {name: {} for name in self.cameras}
        for kind, of_kind in self._videos.items():
            for name, video in of_kind.items():
                out[name][kind] = [f"{i:06d}" for i in range(video.frames)]
        for kind, images in self._images.items():
            for name, stream in images.items():
                out[name][kind] = numbers_of_frames(list(stream.files), self._videos["color"][name].frames)
        return out

    def pictures(self, wanted: Wanted) -> Iterator[SourceImage]:
        for kind, of_kind in self._videos.items():
            for name, video in of_kind.items():
                for index, pixels in enumerate(video.images()):
                    if wanted(name, kind, index):
                        yield SourceImage(name, kind, index, pixels())
        for kind, images in self._images.items():
            for name, stream in images.items():
                for index, file in enumerate(stream.files.values()):
                    if wanted(name, kind, index):
                        yield SourceImage(name, kind, index, read_picture(self._root / file, kind))


class Video:
    """The first video stream of a file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with open_video(path) as file, video_faults(path):
            if not file.streams.video:
                raise ConfigError(f"{path}: no video in it. Is it the right file?")
            stream = file.streams.video[0]
            self.size = (int(stream.width), int(stream.height))
            self.grey16 = str(stream.format.name if stream.format else "").startswith("gray16")
            if not 0 < max(self.size) <= MAX_SIDE:
                raise ConfigError(f"{path}: {self.size[0]}x{self.size[1]} px seen, {MAX_SIDE} a side at most needed")
            self.frames = sum(1 for packet in file.demux(stream) if packet.size)
        if not 0 < self.frames <= _MAX_FRAMES:
            raise ConfigError(f"{path}: {self.frames} frames seen, 1 to {_MAX_FRAMES} needed. Is it complete?")

    def images(self) -> Iterator[Any]:
        """For each frame a function that gives its pixels: B G R (h, w, 3), uint8, or (h, w), uint16."""
        with open_video(self._path) as file:
            decoded = file.decode(video=0)
            while True:
                with video_faults(self._path):
                    frame = next(decoded, None)
                if frame is None:
                    return
                yield lambda frame=frame: self._pixels(frame)

    def _pixels(self, frame: Any) -> np.ndarray:
        with video_faults(self._path):
            pixels: np.ndarray = frame.to_ndarray(format="gray16le" if self.grey16 else "bgr24")
            return pixels


def numbers_of_frames(names: Sequence[str], n: int) -> list[str]:
    """Names of a video's n frames for images of these names: their own numbers where they fit, else their order."""
    values = [int(name) if name.isdigit() and len(name) < 10 else -1 for name in names]
    first = 1 if 0 not in values else 0
    if names and min(values) >= first and max(values) < n + first and len(set(values)) == len(values):
        return [f"{value - first:06d}" for value in values]
    return [f"{i:06d}" for i in range(len(names))]


def _kind(relative: str, video: Video) -> Kind | None:
    words = {token.lower() for token in TOKENS.findall(relative)}
    infrared = any(word in ("ir", "infrared", "infra") for word in words)
    if video.grey16:
        return "ir" if infrared else "depth"
    if any(word.startswith("depth") for word in words):
        return None
    return "ir" if infrared else "color"

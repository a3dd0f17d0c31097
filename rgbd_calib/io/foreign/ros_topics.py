"""Which topics of a bag are whose colour, depth and infrared images, from their names."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.foreign.bag import COMPRESSED, IMAGE
from rgbd_calib.io.foreign.source import Kind

_STREAM_WORDS = ("color", "colour", "rgb", "depth", "image", "ir", "infra", "hd", "sd", "qhd", "left", "right", "mono")
_REGISTERED = ("align", "regist")


@dataclass(frozen=True)
class CameraTopics:
    """The image topics of one camera."""

    color: str
    depth: str | None = None
    ir: str | None = None

    def __iter__(self) -> Iterator[tuple[Kind, str]]:
        yield "color", self.color
        if self.depth:
            yield "depth", self.depth
        if self.ir:
            yield "ir", self.ir

    @property
    def says_registered(self) -> bool:
        return self.depth is not None and any(word in self.depth for word in _REGISTERED)


def parse_topics(texts: tuple[str, ...]) -> dict[str, CameraTopics]:
    """{camera: topics} of options `ID=COLOR[,DEPTH[,IR]]`.

    Raises
    ------
    ConfigError
        Not of that form.
    """
    topics: dict[str, CameraTopics] = {}
    for text in texts:
        camera, _, named = text.partition("=")
        parts = named.split(",")
        if not camera or len(parts) > 3 or not all(part.startswith("/") for part in parts):
            raise ConfigError(f"--topics {text}: ID=/colour/topic,/depth/topic needed")
        topics[camera] = CameraTopics(*parts)
    return topics


def is_depth(topic: str) -> bool:
    return "depth" in topic.lower()


def is_infrared(topic: str) -> bool:
    return "infra" in topic.lower() or "/ir" in topic.lower() or topic.lower().endswith("_ir")


def find_topics(path: Path, types: Mapping[str, str]) -> dict[str, CameraTopics]:
    """Topics by camera: what stands before the stream, as /NAMESPACE/color/image_raw, names the camera.

    Raises
    ------
    ConfigError
        No colour images, or several topics of one kind of which none is preferred.
    """
    found: dict[str, dict[Kind, list[str]]] = defaultdict(lambda: {"color": [], "depth": [], "ir": []})
    for topic, message in sorted(types.items()):
        if message in (IMAGE, COMPRESSED):
            kind: Kind = "ir" if is_infrared(topic) else "depth" if is_depth(topic) else "color"
            found[_namespace(topic)][kind].append(topic)
    bare = [camera for camera, streams in found.items() if not streams["color"]]
    colored = [camera for camera, streams in found.items() if streams["color"]]
    if len(colored) == 1 and not found[colored[0]]["depth"] and len(bare) == 1:  # /kinect2/hd and /kinect2/sd
        for kind in ("depth", "ir"):
            found[colored[0]][kind] = found[bare[0]][kind]
    topics = {}
    for camera in colored:
        streams = found[camera]
        depth, color = _preferred(streams["depth"], _REGISTERED), _preferred(streams["color"], ("rect",))
        if color is None or (streams["depth"] and depth is None):
            seen = ", ".join(streams["color"] + streams["depth"])
            raise ConfigError(
                f"{path}: {camera}: several image topics: {seen}. Choose with --topics {camera}=COLOUR,DEPTH"
            )
        topics[camera] = CameraTopics(color, depth, _preferred(streams["ir"], ("1", "left")))
    if not topics:
        raise ConfigError(
            f"{path}: no colour image topic in it; topics: {', '.join(types)[:500] or 'none'}. Name it with --topics"
        )
    return topics


def _namespace(topic: str) -> str:
    parts = topic.strip("/").split("/")
    named = (i for i, part in enumerate(parts) if any(word in part.lower() for word in _STREAM_WORDS[:7]))
    first = next(named, len(parts) - 1)
    while first > 0 and parts[first - 1].lower() in _STREAM_WORDS[7:10]:
        first -= 1
    return "_".join(parts[:first]) or "C1"


def _preferred(topics: list[str], words: tuple[str, ...]) -> str | None:
    """The only topic, else the only one with one of the words, and raw before compressed; None where that decides not."""
    raw = [t for t in topics if "compressed" not in t] or topics
    named = [t for t in raw if any(w in t for w in words)]
    return raw[0] if len(raw) == 1 else named[0] if len(named) == 1 else None

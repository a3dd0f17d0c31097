"""ROS 1 bags, ROS 2 bags and MCAP files, through `rosbags`."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rgbd_calib.errors import ConfigError, RgbdCalibError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.bag_limits import limit_expansion
from rgbd_calib.io.foreign.ros_images import decode_image, is_depth
from rgbd_calib.io.foreign.source import Kind, Picture, Stamps
from rgbd_calib.io.schema_parts import IntrinsicsModel

SUFFIXES = (".bag", ".mcap", ".db3")
_IMAGE, _COMPRESSED, _INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
_STREAM_WORDS = ("color", "colour", "rgb", "depth", "image", "ir", "infra")


def is_bag(path: Path) -> bool:
    """True for a bag file, an MCAP file, or the folder of a ROS 2 bag."""
    return path.suffix in SUFFIXES or (path / "metadata.yaml").is_file()


class RosBag:
    """The cameras of one bag; times are those of the messages' headers.

    Parameters
    ----------
    topics
        {camera: (colour topic, depth topic or None)}; empty: found by name and type.
    """

    depth_scale = 0.001

    def __init__(self, path: Path, topics: Mapping[str, tuple[str, str | None]] | None = None) -> None:
        self.name = str(path)
        self._path = path
        self._stamps: dict[str, dict[Kind, list[int]]] = {}
        with self._reader() as reader:
            types = {c.topic: c.msgtype for c in reader.connections}
            self._topics = dict(topics) if topics else _find_topics(path, types)
            self._check(types)
            self._streams = {t: (camera, kind) for camera, kind, t in self._listed()}
            self.intrinsics: Mapping[str, Intrinsics] = self._read_intrinsics(reader)
        registered = all("regist" in d or "align" in d for _, d in self._topics.values() if d)
        self.remarks: tuple[str, ...] = () if registered else (_unregistered_remark(self.name),)

    def stamps(self) -> Mapping[str, Stamps]:
        if not self._stamps:
            found: dict[str, dict[Kind, list[int]]] = defaultdict(lambda: {"color": [], "depth": []})
            with self._reader() as reader:
                for camera, kind, message in self._messages(reader):
                    with _faults(self.name):
                        found[camera][kind].append(_time_us(message))
            self._stamps = dict(found)
        return self._stamps

    def pictures(self) -> Iterator[Picture]:
        counts: dict[tuple[str, Kind], int] = defaultdict(int)
        with self._reader() as reader:
            for camera, kind, message in self._messages(reader):
                where = f"{self.name}: {self._topics[camera][0 if kind == 'color' else 1]}"
                with _faults(where):
                    pixels = decode_image(message, kind, where)
                yield Picture(camera, kind, counts[camera, kind], pixels)
                counts[camera, kind] += 1

    @contextmanager
    def _reader(self) -> Iterator[Any]:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        limit_expansion()
        with _faults(self.name):
            reader = AnyReader([self._path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            reader.open()
            if not all(isinstance(text, str) for c in reader.connections for text in (c.topic, c.msgtype)):
                reader.close()
                raise ValueError("a topic whose name is no text")  # SQLite keeps bytes and nothing in columns of text
        try:
            yield reader
        finally:
            reader.close()

    def _messages(self, reader: Any) -> Iterator[tuple[str, Kind, Any]]:
        wanted = [c for c in reader.connections if c.topic in self._streams]
        for topic, message in self._read(reader, wanted):
            camera, kind = self._streams[topic]
            yield camera, kind, message

    def _read(self, reader: Any, connections: list[Any]) -> Iterator[tuple[str, Any]]:
        """(topic, message) of some of the connections; of none where there are none."""
        raw = reader.messages(connections=connections) if connections else iter(())
        while True:
            with _faults(self.name):
                connection, _, data = next(raw, (None, 0, b""))
                if connection is None:
                    return
                message = reader.deserialize(data, connection.msgtype)
            yield connection.topic, message

    def _listed(self) -> Iterator[tuple[str, Kind, str]]:
        for camera, (color, depth) in self._topics.items():
            yield camera, "color", color
            if depth:
                yield camera, "depth", depth

    def _check(self, types: Mapping[str, str]) -> None:
        for camera, _, topic in self._listed():
            if types.get(topic) not in (_IMAGE, _COMPRESSED):
                images = ", ".join(t for t, kind in types.items() if kind in (_IMAGE, _COMPRESSED)) or "none"
                raise ConfigError(
                    f"{self.name}: {camera}: {topic} is no image topic of it; there are {images}. Correct --topics"
                )

    def _read_intrinsics(self, reader: Any) -> dict[str, Intrinsics]:
        infos = {}
        for camera, (color, _) in self._topics.items():
            topic = color.removesuffix("/compressed").rpartition("/")[0] + "/camera_info"
            connections = [c for c in reader.connections if c.topic == topic and c.msgtype == _INFO]
            for _, message in self._read(reader, connections):
                with _faults(f"{self.name}: {topic}"):
                    found = _intrinsics(message)
                if found is not None:
                    infos[camera] = found
                break
        return infos


@contextmanager
def _faults(where: str) -> Iterator[None]:
    """What `rosbags` raises on damaged files (struct.error, KeyError, AssertionError, ...) becomes an error for people."""
    try:
        yield
    except RgbdCalibError:
        raise
    except Exception as error:
        why = " ".join(str(error).split())[:200] or type(error).__name__
        raise ConfigError(f"{where}: cannot be read as a ROS bag ({why}). Is it complete? Copy it again") from error


def parse_topics(texts: tuple[str, ...]) -> dict[str, tuple[str, str | None]]:
    """{camera: (colour topic, depth topic)} of options `ID=COLOR[,DEPTH]`.

    Raises
    ------
    ConfigError
        Not of that form.
    """
    topics: dict[str, tuple[str, str | None]] = {}
    for text in texts:
        camera, _, named = text.partition("=")
        parts = named.split(",")
        if not camera or not parts[0].startswith("/") or len(parts) > 2:
            raise ConfigError(f"--topics {text}: ID=/colour/topic,/depth/topic needed")
        topics[camera] = (parts[0], parts[1] if len(parts) == 2 else None)
    return topics


def _find_topics(path: Path, types: Mapping[str, str]) -> dict[str, tuple[str, str | None]]:
    """Colour and depth topics by camera, from the names: /NAMESPACE/color/image_raw and the like."""
    found: dict[str, dict[Kind, list[str]]] = defaultdict(lambda: {"color": [], "depth": []})
    for topic, kind in sorted(types.items()):
        if kind not in (_IMAGE, _COMPRESSED) or "infra" in topic or "/ir" in topic:
            continue
        parts = topic.strip("/").split("/")
        first = next((i for i, part in enumerate(parts) if any(w in part for w in _STREAM_WORDS)), len(parts) - 1)
        found["_".join(parts[:first]) or "C1"]["depth" if is_depth(topic) else "color"].append(topic)
    topics = {}
    for camera, streams in found.items():
        if not streams["color"]:
            continue
        depth = _preferred(streams["depth"], ("align", "regist"))
        color = _preferred(streams["color"], ("rect",))
        if color is None or (streams["depth"] and depth is None):
            seen = ", ".join(streams["color"] + streams["depth"])
            raise ConfigError(
                f"{path}: {camera}: several image topics: {seen}. Choose with --topics {camera}=COLOUR,DEPTH"
            )
        topics[camera] = (color, depth)
    if not topics:
        raise ConfigError(
            f"{path}: no colour image topic in it; topics: {', '.join(types) or 'none'}. Name it with --topics"
        )
    return topics


def _preferred(topics: list[str], words: tuple[str, ...]) -> str | None:
    """The only topic, else the only one with one of the words, and raw before compressed; None where that decides not."""
    raw = [t for t in topics if "compressed" not in t] or topics
    named = [t for t in raw if any(w in t for w in words)]
    return raw[0] if len(raw) == 1 else named[0] if len(named) == 1 else None


def _unregistered_remark(name: str) -> str:
    return (
        f"{name}: nothing says whether depth is registered to colour; it is taken as registered. If it is not, import the "
        "registered topic (--topics), or colour alone (--color-only)"
    )


def _time_us(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000 + int(stamp.nanosec) // 1000


def _intrinsics(info: Any) -> Intrinsics | None:
    K = np.asarray(info.K if hasattr(info, "K") else info.k, float).reshape(3, 3)
    D = np.asarray(info.D if hasattr(info, "D") else info.d, float).ravel()
    if not K[0, 0] > 0 or info.distortion_model not in ("plumb_bob", "") or len(D) > 5:
        return None
    k1, k2, p1, p2, k3 = (float(v) for v in np.pad(D, (0, 5 - len(D))))
    fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    model = IntrinsicsModel(
        width=int(info.width), height=int(info.height), fx=fx, fy=fy, cx=cx, cy=cy, distortion=[k1, k2, p1, p2, k3]
    )
    return model.value()

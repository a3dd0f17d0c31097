"""ROS 1 bags, ROS 2 bags and MCAP files as streams of messages, through `rosbags`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.bag_limits import limit_expansion
from rgbd_calib.io.calibrations.common import rigid_of_quaternion
from rgbd_calib.io.foreign.damaged import faults
from rgbd_calib.io.foreign.orbbec_bag import OrbbecReader, is_orbbec

SUFFIXES = (".bag", ".mcap", ".db3")
IMAGE, COMPRESSED, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"


def is_bag(path: Path) -> bool:
    """True for a bag file, an MCAP file, or the folder of a ROS 2 bag."""
    return path.suffix.lower() in SUFFIXES or (path / "metadata.yaml").is_file()


class Bag:
    """A bag that is open."""

    def __init__(self, path: Path, reader: Any) -> None:
        self.name = str(path)
        self._reader = reader
        self.types: dict[str, str] = {c.topic: c.msgtype for c in reader.connections}
        """Message type by topic."""

    def messages(self, topics: Callable[[str], bool]) -> Iterator[tuple[str, int, Callable[[], Any]]]:
        """(topic, time of recording in ns, how to read the message) of the topics, in the order of recording."""
        wanted = [c for c in self._reader.connections if topics(c.topic)]
        raw = self._reader.messages(connections=wanted) if wanted else iter(())
        while True:
            with bag_faults(self.name):
                connection, time_ns, data = next(raw, (None, 0, b""))
                if connection is None:
                    return
            yield connection.topic, int(time_ns), lambda c=connection, d=data: self._read(c, d)  # type: ignore[misc]

    def first(self, topic: str) -> Any | None:
        """The first message of a topic; None where there is none."""
        for _, _, read in self.messages(lambda name: name == topic):
            return read()
        return None

    def all(self, topic: str) -> Iterator[Any]:
        """All messages of a topic."""
        for _, _, read in self.messages(lambda name: name == topic):
            yield read()

    def _read(self, connection: Any, data: Any) -> Any:
        with bag_faults(f"{self.name}: {connection.topic}"):
            return self._reader.deserialize(data, connection.msgtype)


_ROS_1 = b"#ROSBAG V2.0\n"


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag.

    Raises
    ------
    ConfigError
        It is damaged, or none.
    """
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.typesys import Stores, get_typestore

    limit_expansion()
    with bag_faults(str(path)):
        if path.suffix == ".bag":
            with path.open("rb") as stream:
                if stream.read(len(_ROS_1)) != _ROS_1:  # its reader looks for the end of the line, however far it is
                    raise ValueError(f"{_ROS_1.decode()!r} expected at the begin")
        reader: Any = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        try:
            reader.open()
        except AnyReaderError:
            if path.suffix != ".bag":
                raise
            reader = OrbbecReader(path)
            if not is_orbbec({c.topic: c.msgtype for c in reader.connections}):
                reader.close()
                raise
        if not all(isinstance(text, str) for c in reader.connections for text in (c.topic, c.msgtype)):
            reader.close()
            raise ValueError("a topic whose name is no text")  # SQLite keeps bytes and nothing in columns of text
    try:
        yield Bag(path, reader)
    finally:
        reader.close()


def bag_faults(where: str) -> AbstractContextManager[None]:
    """What `rosbags` raises becomes an error for people."""
    return faults(where, "a ROS bag")


def stamp_us(message: Any) -> int:
    """Time of a message's header, us."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000 + int(stamp.nanosec) // 1000


def matrices(message: Any) -> tuple[FloatArray, FloatArray]:
    """K (9,) and D of a CameraInfo, which ROS 2 spells in small letters."""
    K, D = (message.K, message.D) if hasattr(message, "K") else (message.k, message.d)
    return np.asarray(K, float), np.asarray(D, float)


def motion(where: Path, key: str, transform: Any) -> FloatArray:
    """A geometry_msgs Transform as (4, 4)."""
    q, t = transform.rotation, transform.translation
    return rigid_of_quaternion(where, key, (q.w, q.x, q.y, q.z), np.array([t.x, t.y, t.z]))

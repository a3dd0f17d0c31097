"""Bags of the Orbbec SDK 2.4 and later, which are not quite those of ROS: their checksums are the SDK's own, and frames have
four bytes behind the pixels (depth_units) that the definition in the file does not have.

https://github.com/orbbec/OrbbecSDK_v2 (3rdparty/rosbag/src/msgs)
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

FRAME = re.compile(r"/cam/sensor_(\d+)/frameType_(\d+)")
_IMAGE_DIGEST = "060021388200f6f0f447d0fcd9c64743"
_PIXELS = re.compile(r"^uint8\[\] data\b.*$", re.MULTILINE)


def is_orbbec(topics: Mapping[str, str]) -> bool:
    return any(FRAME.fullmatch(topic) for topic in topics)


class OrbbecReader:
    """What :class:`Bag` uses of `rosbags`' AnyReader. Definitions are parsed when a message of their type is read: that of the
    IMU is none of ROS."""

    def __init__(self, path: Path) -> None:
        from rosbags.rosbag1 import Reader

        self._reader = Reader(path)
        self._reader.open()
        self.connections = self._reader.connections
        self._stores: dict[str, Any] = {}

    def messages(self, connections: Sequence[Any]) -> Iterator[tuple[Any, int, Any]]:
        return self._reader.messages(connections=connections)

    def deserialize(self, data: Any, msgtype: str) -> Any:
        if msgtype not in self._stores:
            self._stores[msgtype] = self._store(msgtype)
        return self._stores[msgtype].deserialize_ros1(data, msgtype)

    def close(self) -> None:
        self._reader.close()

    def _store(self, msgtype: str) -> Any:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        connection = next(c for c in self.connections if c.msgtype == msgtype)
        text = connection.msgdef.data
        if connection.digest == _IMAGE_DIGEST:
            text = _PIXELS.sub("uint8[] data\nfloat32 depth_units", text, count=1)
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(text, msgtype))
        return store

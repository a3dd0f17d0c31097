"""Files as other programs write them: pictures, videos, ROS 2 bags."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbd_calib.geometry import so3

K = [50.0, 0, 31.5, 0, 51.0, 23.5, 0, 0, 1]


def save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, image)
    elif path.suffix == ".npz":
        np.savez(path, depth=image)
    else:
        assert cv2.imwrite(str(path), image)


def write_video(path: Path, frames: np.ndarray, codec: str = "ffv1", pixels: str = "bgr0") -> None:
    """A lossless video of B G R or 16-bit frames."""
    av = pytest.importorskip("av")
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as file:
        stream = file.add_stream(codec, rate=30)
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = pixels
        for image in frames:
            kind = "bgr24" if image.ndim == 3 else "gray16le"
            file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format=kind)))
        file.mux(stream.encode())


class Bag2:
    """A ROS 2 bag that is being written."""

    def __init__(self, writer, store) -> None:
        self._writer, self._store, self.types, self._topics = writer, store, store.types, {}

    def put(self, topic: str, time_us: int, message) -> None:
        kind = message.__msgtype__
        if topic not in self._topics:
            self._topics[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        self._writer.write(self._topics[topic], time_us * 1000, self._store.serialize_cdr(message, kind))

    def header(self, time_us: int, frame: str = ""):
        stamp = self.types["builtin_interfaces/msg/Time"](time_us // 1_000_000, time_us % 1_000_000 * 1000)
        return self.types["std_msgs/msg/Header"](stamp, frame)

    def image(self, topic: str, time_us: int, pixels: np.ndarray, encoding: str, frame: str = "") -> None:
        data = np.frombuffer(pixels.tobytes(), np.uint8)
        step = data.size // pixels.shape[0]
        made = self.types["sensor_msgs/msg/Image"](
            self.header(time_us, frame), *pixels.shape[:2], encoding, 0, step, data
        )
        self.put(topic, time_us, made)

    def info(self, topic: str, size: tuple[int, int], model: str, d: list[float], k: list[float] = K) -> None:
        roi = self.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        arrays = {"d": np.array(d), "k": np.array(k), "r": np.eye(3).ravel(), "p": np.zeros(12)}
        width, height = size
        made = self.types["sensor_msgs/msg/CameraInfo"](
            self.header(1), height, width, model, binning_x=0, binning_y=0, roi=roi, **arrays
        )
        self.put(topic, 1_000_000, made)

    def tf_static(self, parent: str, child: str, T: np.ndarray) -> None:
        t, q = T[:3, 3], so3.quaternion_wxyz(T[:3, :3])
        types = self.types
        own = types["geometry_msgs/msg/Transform"](
            types["geometry_msgs/msg/Vector3"](*map(float, t)),
            types["geometry_msgs/msg/Quaternion"](*map(float, (q[1], q[2], q[3], q[0]))),
        )
        stamped = types["geometry_msgs/msg/TransformStamped"](self.header(1, parent), child, own)
        self.put("/tf_static", 1_000_000, types["tf2_msgs/msg/TFMessage"]([stamped]))


@contextmanager
def bag2(path: Path):
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        yield Bag2(writer, store)

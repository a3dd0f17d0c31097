"""Bags for `fuzz.py`: small ones of each kind, and their readers."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rgbd_calib.io.foreign.orbbec import OrbbecBag
from rgbd_calib.io.foreign.realsense import RealSenseBag
from rgbd_calib.io.foreign.ros import RosBag
from rgbd_calib.io.foreign.source import Source

Reader = Callable[[bytes], object]


def everything(*picture: object) -> bool:
    """All pictures are wanted."""
    return True


def all_of(source: Source) -> object:
    """Everything that a source gives."""
    return source.cameras, source.stamps(), source.stems(), list(source.pictures(everything))


def readers(folder: Path) -> dict[str, tuple[Reader, bytes]]:
    """For each kind how bytes are read, and a whole bag."""
    _remember_types()
    made: dict[str, tuple[Reader, bytes]] = {}
    for kind, suffix in (("ROS 1 bag", "bag"), ("MCAP", "mcap"), ("ROS 2 db3", "db3")):
        seed, path = _bag(folder / f"bag_{suffix}", suffix), folder / f"fuzzed.{suffix}"

        def read(data: bytes, path: Path = path) -> object:
            path.write_bytes(data)
            source = RosBag(path)
            return source.stamps(), list(source.pictures(everything))

        made[kind] = read, seed
    for kind, suffix, reader in (("RealSense db3", "db3", RealSenseBag), ("Orbbec bag", "bag", OrbbecBag)):
        seed, path = _makers_bag(folder / f"maker_{suffix}", suffix), folder / f"maker.{suffix}"

        def read_maker(data: bytes, path: Path = path, reader: Any = reader) -> object:
            path.write_bytes(data)
            return all_of(reader(path, "C1"))

        made[kind] = read_maker, seed
    return made


def _makers_bag(folder: Path, suffix: str) -> bytes:
    """A recording of librealsense (.db3) or the Orbbec SDK (.bag), as far as its reader looks."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if suffix == "bag" else Stores.ROS2_HUMBLE)
    store.register(
        get_types_from_msg(
            "float32[] cameraIntrinsic\nfloat32[] cameraDistortion\nuint8 distortionModel\nuint16 width\nuint16 height\n"
            "float32[] rotationMatrix\nfloat32[] translationMatrix\n",
            "custom_msg/msg/StreamProfileInfo",
        )
    )
    types: Any = store.types
    path = folder.with_suffix(".bag") if suffix == "bag" else folder
    writer: Any = Writer1(path) if suffix == "bag" else Writer2(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
    serialize = store.serialize_ros1 if suffix == "bag" else store.serialize_cdr
    more = {"seq": 0} if suffix == "bag" else {}
    header = types["std_msgs/msg/Header"](stamp=types["builtin_interfaces/msg/Time"](1, 2), frame_id="", **more)

    def image(encoding: str, *shape: int) -> Any:
        data = np.arange(np.prod(shape), dtype=np.uint8)
        return types["sensor_msgs/msg/Image"](header, *shape[:2], encoding, 0, data.size // shape[0], data)

    def text(value: str) -> Any:
        return types["std_msgs/msg/String"](value)

    if suffix == "bag":
        lens = np.array([9, 9, 3.5, 2.5], np.float32)
        profile = types["custom_msg/msg/StreamProfileInfo"](
            lens, np.zeros(8, np.float32), 4, 8, 6, np.eye(3, dtype=np.float32).ravel(), np.zeros(3, np.float32)
        )
        messages = [(f"/cam/streamProfileType_{n}", profile) for n in (2, 3)]
        messages += [
            ("/cam/sensor_2/frameType_2", image("bgr8", 6, 8, 3)),
            ("/cam/sensor_3/frameType_3", image("mono16", 6, 8, 2)),
        ]
    else:
        lens = "width=8;height=6;fx=9;fy=9;ppx=3.5;ppy=2.5;model=2;coeffs=0.1,0,0,0,0"
        messages = [("/device_0/info", text("Serial Number=0001"))]
        for n, (name, encoding, size) in enumerate((("Depth", "mono16", 2), ("Color", "rgb8", 3))):
            base = f"/device_0/sensor_{n}/{name}_0"
            messages += [
                (f"{base}/camera_info", text(lens.replace("model=2", "model=Brown Conrady"))),
                (f"{base}/tf/0", text("rotation=1,0,0,0,1,0,0,0,1;translation=0.01,0,0")),
                (f"{base}/image/data", image(encoding, 6, 8, size)),
                (f"{base}/image/metadata", text("timestamp_domain=Hardware Clock")),
            ]
        messages.append(("/device_0/sensor_0/option/Depth_Units/value", types["std_msgs/msg/Float32"](0.001)))
    with writer:
        for topic, message in messages:
            connection = writer.add_connection(topic, message.__msgtype__, typestore=store)
            writer.write(connection, 1_000_000_002, serialize(message, message.__msgtype__))
    data = path.read_bytes() if suffix == "bag" else next(path.glob("*.db3")).read_bytes()
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    return data


def _bag(folder: Path, suffix: str) -> bytes:
    """A bag with one image and its camera_info."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if suffix == "bag" else Stores.ROS2_HUMBLE)
    types: Any = store.types
    plugin = StoragePlugin.MCAP if suffix == "mcap" else StoragePlugin.SQLITE3
    path = folder.with_suffix(".bag") if suffix == "bag" else folder
    writer: Any = Writer1(path) if suffix == "bag" else Writer2(path, version=9, storage_plugin=plugin)
    more = {"seq": 0} if suffix == "bag" else {}
    header = types["std_msgs/msg/Header"](
        stamp=types["builtin_interfaces/msg/Time"](sec=1, nanosec=2), frame_id="", **more
    )
    image = types["sensor_msgs/msg/Image"](header, 2, 3, "rgb8", 0, 9, np.arange(18, dtype=np.uint8))
    with writer:
        topic = writer.add_connection("/left/color/image_raw", "sensor_msgs/msg/Image", typestore=store)
        serialize = store.serialize_ros1 if suffix == "bag" else store.serialize_cdr
        writer.write(topic, 1_000_000_002, serialize(image, image.__msgtype__))
    data = path.read_bytes() if suffix == "bag" else next(path.glob(f"*.{suffix}")).read_bytes()
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    return data


def _remember_types() -> None:
    """Compile message definitions that were seen before only once: 50 ms of 52 for each bag."""
    import rosbags.highlevel.anyreader as reader
    import rosbags.serde.utils as serde
    import rosbags.typesys.store as store

    if hasattr(reader.get_types_from_msg, "cache_info"):
        return
    reader.get_types_from_msg = functools.lru_cache(1000)(reader.get_types_from_msg)
    generate = store.generate_python_code
    codes: dict[str, str] = {}
    made: dict[str, dict[str, Any]] = {}

    def generate_once(typs: Any) -> str:
        key = repr(typs)
        if key not in codes:
            codes[key] = generate(typs)
        return codes[key]

    def run_once(code: str, space: dict[str, Any]) -> None:
        if code not in made:
            if len(made) > 1000:
                made.clear()
            fresh = dict(space)
            exec(code, fresh)
            made[code] = fresh
        space.update(made[code])

    store.generate_python_code = generate_once
    store.exec = serde.exec = run_once  # type: ignore[attr-defined]

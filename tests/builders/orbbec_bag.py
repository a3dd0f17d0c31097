"""Recordings of Orbbec cameras as the SDK writes them (.bag of ROS 1, SDK 2.4 and later), byte for byte.

The SDK's frames have a float behind the pixels that the definition in the file does not have, and checksums of its own; so
the messages are packed here. The SDK itself plays such a file (tests/sensors/test_orbbec.py).
https://github.com/orbbec/OrbbecSDK_v2 (src/media/ros, 3rdparty/rosbag)
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

SERIAL = "CL8F253004Z"
LENS = (600.0, 601.0, 320.0, 241.0)
DISTORTION = (0.1, -0.05, 0.01, 0.02, 0.03, 0.04, 0.001, 0.002)
"""k1 to k6, p1, p2."""
R_COLOR_DEPTH = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
T_COLOR_DEPTH_MM = (-32.0, 1.0, 2.0)
START_US, PERIOD_US = 1_000_000, 33_333
SENSORS = {"ir": 1, "color": 2, "depth": 3}
_FORMATS = {"ir": 8, "color": 22, "depth": 8}
"""OBFormat: Y16, RGB."""
_HEADER = "MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
_TYPES = {
    "sensor_msgs/msg/Image": (
        "060021388200f6f0f447d0fcd9c64743",
        "Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n"
        "uint64 number\nuint64 timestamp_usec\nuint64 timestamp_systemusec\nuint64 timestamp_globalusec\nuint8[] metadata\n"
        "uint32 metadatasize\n",
    ),
    "sensor_msgs/msg/Imu": ("6a62c6daae103f4ff57a132d6f95cec2", "Header header\nfloat temperature\n"),
    "custom_msg/msg/OBProperty": (
        "0123456789abcdef0123456789abcdef",
        "std_msgs/Header header\nuint8 propertyId\nuint8[] data\nuint32 datasize\n",
    ),
    "custom_msg/msg/OBDeviceInfo": (
        "afef5328bb4abebd1a309e1ea8b26b3a",
        "std_msgs/Header header\nstring name\nstring fullName\nstring asicName\nuint16 vid\nuint16 pid\nstring uid\nstring sn\n"
        "string fwVersion\nstring hwVersion\nstring supportedSdkVersion\nstring connectionType\nuint16 type\n"
        "uint8 backendType\nstring ipAddress\nstring localMac\n",
    ),
    "custom_msg/msg/OBStreamProfileInfo": (
        "0123456789abcdef0123456789abcdef",
        "std_msgs/Header header\nuint8 streamType\nuint8 format\nfloat32[9] rotationMatrix\nfloat32[3] translationMatrix\n"
        "uint16 width\nuint16 height\nuint16 fps\nfloat32[4] cameraIntrinsic\nfloat32[8] cameraDistortion\n"
        "uint8 distortionModel\n",
    ),
}
"""Checksums and definitions as in a file of the SDK."""


def write_orbbec_bag(path: Path, frames: dict[str, list[np.ndarray]], imu: bool = False) -> Path:
    """`frames` by stream: colour R G B, depth and infrared 16 bits; `imu`: a topic of a type that is none of ROS is listed."""
    from rosbags.rosbag1 import Writer

    with Writer(path) as writer:

        def topic(name: str, kind: str):
            checksum, definition = _TYPES[kind]
            text = f"{definition}\n{80 * '='}\n{_HEADER}"
            return writer.add_connection(f"/cam/{name}", kind, msgdef=text, md5sum=checksum)

        if imu:
            topic("sensor_4/frameType_4", "sensor_msgs/msg/Imu")
        streams = {k: topic(f"sensor_{SENSORS[k]}/frameType_{SENSORS[k]}", "sensor_msgs/msg/Image") for k in frames}
        for n in range(len(frames["color"])):
            time_us = START_US + n * PERIOD_US
            for kind, connection in streams.items():
                writer.write(connection, 1000 * time_us, _image(time_us, frames[kind][n], n))
        version = struct.pack("<d", 2.0)
        property_ = _head(START_US) + struct.pack("<II", 0, len(version)) + version + struct.pack("<I", len(version))
        writer.write(topic("property", "custom_msg/msg/OBProperty"), 1000 * START_US, property_)
        writer.write(topic("deviceInfo", "custom_msg/msg/OBDeviceInfo"), 1000 * START_US, _device())
        for kind, images in frames.items():
            profile = topic(f"streamProfileType_{SENSORS[kind]}", "custom_msg/msg/OBStreamProfileInfo")
            writer.write(profile, 1000 * START_US, _profile(kind, images[0].shape))
    return path


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def _head(time_us: int) -> bytes:
    return struct.pack("<III", 0, time_us // 1_000_000, time_us % 1_000_000 * 1000) + _text("")


def _image(time_us: int, image: np.ndarray, number: int) -> bytes:
    height, width = image.shape[:2]
    data = image.tobytes()
    return (
        _head(time_us)
        + struct.pack("<II", height, width)
        + _text("rgb8" if image.ndim == 3 else "mono16")
        + struct.pack("<BII", 0, len(data) // height, len(data))
        + data
        + struct.pack("<f", 0.0)  # depth_units, which the definition does not have
        + struct.pack("<QQQQII", number, time_us, time_us, time_us, 0, 0)
    )


def _device() -> bytes:
    texts = [
        _text(t)
        for t in ("Orbbec Femto Bolt", "Orbbec Femto Bolt", "", "2-1.3-5", SERIAL, "1.1.2", "1.0", "1.0", "USB3.2")
    ]
    ids = struct.pack("<HH", 0x2BC5, 0x066B)
    return b"".join([_head(START_US), *texts[:3], ids, *texts[3:], struct.pack("<HB", 1, 0), _text(""), _text("")])


def _profile(kind: str, shape: tuple[int, ...]) -> bytes:
    R, t = (R_COLOR_DEPTH.ravel(), T_COLOR_DEPTH_MM) if kind == "depth" else (np.zeros(9), (0.0, 0.0, 0.0))
    return (
        _head(START_US)
        + struct.pack("<BB9f3f", SENSORS[kind], _FORMATS[kind], *R, *t)
        + struct.pack("<HHH4f8fB", shape[1], shape[0], 30, *LENS, *DISTORTION, 4)
    )

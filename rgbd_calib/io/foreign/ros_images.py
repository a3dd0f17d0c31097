"""Images of ROS messages as arrays."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.foreign.source import Kind

_COMPRESSED_DEPTH_HEADER = 12  # bytes before the PNG, written by compressed_depth_image_transport
_CHANNELS = {
    "rgb8": 3,
    "bgr8": 3,
    "rgba8": 4,
    "bgra8": 4,
    "mono8": 1,
    "8UC1": 1,
    "8UC3": 3,
    "yuv422": 2,
    "yuv422_yuy2": 2,
}
_TO_BGR = {
    "rgb8": cv2.COLOR_RGB2BGR,
    "rgba8": cv2.COLOR_RGBA2BGR,
    "bgra8": cv2.COLOR_BGRA2BGR,
    "mono8": cv2.COLOR_GRAY2BGR,
    "8UC1": cv2.COLOR_GRAY2BGR,
    "yuv422": cv2.COLOR_YUV2BGR_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2BGR_YUY2,
    "bayer_rggb8": cv2.COLOR_BayerRGGB2BGR,
    "bayer_bggr8": cv2.COLOR_BayerBGGR2BGR,
    "bayer_gbrg8": cv2.COLOR_BayerGBRG2BGR,
    "bayer_grbg8": cv2.COLOR_BayerGRBG2BGR,
}


def is_depth(topic: str) -> bool:
    return "depth" in topic


def decode_image(message: Any, kind: Kind, where: str) -> np.ndarray:
    """Colour (h, w, 3) uint8, B G R, or depth (h, w) uint16 in mm, of an Image or CompressedImage message.

    Raises
    ------
    ConfigError
        An encoding that is not known; `where` names the file and topic.
    """
    if hasattr(message, "format"):
        return _decode_compressed(message, kind, where)
    encoding = str(message.encoding)
    data = np.asarray(message.data, np.uint8)
    rows = data.reshape(message.height, message.step)
    if kind == "depth":
        sizes = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}
        if encoding not in sizes:
            raise _unknown(where, encoding, "16UC1 or 32FC1")
        dtype = np.dtype(sizes[encoding]).newbyteorder(">" if message.is_bigendian else "<")
        pixels = np.ascontiguousarray(rows[:, : message.width * dtype.itemsize]).view(dtype)
        return _millimetres(pixels) if encoding == "32FC1" else pixels.astype(np.uint16)
    channels = _CHANNELS.get(encoding, 1 if encoding in _TO_BGR else 0)
    if not channels:
        raise _unknown(where, encoding, "an 8-bit colour encoding")
    pixels = np.ascontiguousarray(rows[:, : message.width * channels]).reshape(message.height, message.width, channels)
    if encoding in ("bgr8", "8UC3"):
        return pixels
    return cv2.cvtColor(pixels[..., 0] if channels == 1 else pixels, _TO_BGR[encoding])


def _decode_compressed(message: Any, kind: Kind, where: str) -> np.ndarray:
    data = np.asarray(message.data, np.uint8)
    if kind == "depth":
        if "16UC1" not in message.format and "mono16" not in message.format and "png" not in message.format:
            raise _unknown(where, str(message.format), "16UC1 in PNG")
        if "compressedDepth" in message.format:
            data = data[_COMPRESSED_DEPTH_HEADER:]
    image = cv2.imdecode(data, cv2.IMREAD_COLOR if kind == "color" else cv2.IMREAD_UNCHANGED)
    if image is None or (kind == "depth" and image.dtype != np.uint16):
        raise _unknown(where, str(message.format), "JPEG or PNG, 16 bits for depth")
    return image


def _millimetres(depth_m: np.ndarray) -> np.ndarray:
    """Metres as float to whole millimetres; what is no number or out of range becomes 0."""
    good = np.isfinite(depth_m) & (depth_m > 0) & (depth_m < 65.535)
    return np.where(good, np.rint(np.where(good, depth_m, 0) * 1000), 0).astype(np.uint16)


def _unknown(where: str, seen: str, needed: str) -> ConfigError:
    return ConfigError(
        f"{where}: encoding {seen} seen, {needed} needed. Convert the topic, or choose another with --topics"
    )

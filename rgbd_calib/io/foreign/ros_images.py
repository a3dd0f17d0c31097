"""Images of ROS messages as arrays."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io import images
from rgbd_calib.io.foreign.source import Kind
from rgbd_calib.io.schema_base import MAX_SIDE
from rgbd_calib.io.tables import short

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
    if kind == "depth":
        sizes = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}
        if encoding not in sizes:
            raise _unknown(where, encoding, "16UC1 or 32FC1")
        dtype = np.dtype(sizes[encoding]).newbyteorder(">" if message.is_bigendian else "<")
        pixels = _pixels(message, dtype.itemsize, where).view(dtype)[..., 0]
        return _millimetres(pixels) if encoding == "32FC1" else pixels.astype(np.uint16)
    channels = _CHANNELS.get(encoding, 1 if encoding in _TO_BGR else 0)
    if not channels:
        raise _unknown(where, encoding, "an 8-bit colour encoding")
    pixels = _pixels(message, channels, where)
    if encoding in ("bgr8", "8UC3"):
        return pixels
    return cv2.cvtColor(pixels[..., 0] if channels == 1 else pixels, _TO_BGR[encoding])


def _pixels(message: Any, size: int, where: str) -> np.ndarray:
    """Bytes (height, width, size) of the pixels, without what pads the rows."""
    data = np.asarray(message.data, np.uint8).ravel()
    height, width, step = int(message.height), int(message.width), int(message.step)
    if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE and width * size <= step and height * step == data.size):
        raise ConfigError(
            f"{where}: {width}x{height} px of {size} bytes, rows of {step} bytes, {data.size} bytes seen; {height} rows of "
            f"at least {width * size} bytes needed, {MAX_SIDE} px a side at most. Is the bag complete? Record it again"
        )
    return np.ascontiguousarray(data.reshape(height, step)[:, : width * size]).reshape(height, width, size)


def _decode_compressed(message: Any, kind: Kind, where: str) -> np.ndarray:
    data = np.asarray(message.data, np.uint8)
    if kind == "depth":
        if "16UC1" not in message.format and "mono16" not in message.format and "png" not in message.format:
            raise _unknown(where, str(message.format), "16UC1 in PNG")
        if "compressedDepth" in message.format:
            data = data[_COMPRESSED_DEPTH_HEADER:]
    image = images.decode_image(data.tobytes(), where)
    if image.dtype != (np.uint8 if kind == "color" else np.uint16) or (kind == "depth" and image.ndim != 2):
        raise _unknown(where, f"{short(str(message.format))} of {image.dtype}", "JPEG or PNG, 16 bits for depth")
    return images.as_bgr(image) if kind == "color" else image


def _millimetres(depth_m: np.ndarray) -> np.ndarray:
    """Metres as float to whole millimetres; what is no number or out of range becomes 0."""
    good = np.isfinite(depth_m) & (depth_m > 0) & (depth_m < 65.535)
    return np.where(good, np.rint(np.where(good, depth_m, 0) * 1000), 0).astype(np.uint16)


def _unknown(where: str, seen: str, needed: str) -> ConfigError:
    return ConfigError(
        f"{where}: encoding {seen[:80]!r} seen, {needed} needed. Convert the topic, or choose another with --topics"
    )

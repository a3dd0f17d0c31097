"""Images of ROS messages as pictures."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io import images
from rgbd_calib.io.foreign.source import Encoded, Kind
from rgbd_calib.io.schema_base import MAX_SIDE

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


def picture_of(message: Any, kind: Kind, where: str) -> np.ndarray | Encoded:
    """An Image or CompressedImage message as a picture: depth of 16 bits as it is, 32FC1 in metres.

    Raises
    ------
    ConfigError
        An encoding that is not known, or a damaged image; `where` names the file and topic.
    """
    if hasattr(message, "format"):
        return _decode_compressed(message, kind, where)
    encoding = str(message.encoding)
    if encoding.upper() == "MJPG":
        return Encoded(np.asarray(message.data, np.uint8).tobytes(), ".jpg")
    if kind != "color" and encoding not in _CHANNELS:
        sizes = {"16UC1": np.uint16, "mono16": np.uint16, "Z16": np.uint16, "Y16": np.uint16, "32FC1": np.float32}
        if encoding not in sizes:
            raise _unknown(where, encoding, "16UC1 or 32FC1")
        dtype = np.dtype(sizes[encoding]).newbyteorder(">" if message.is_bigendian else "<")
        pixels = _pixels(message, dtype.itemsize, where).view(dtype)[..., 0]
        return pixels.astype(np.float32 if encoding == "32FC1" else np.uint16)
    if kind == "ir" and _CHANNELS.get(encoding) == 1:
        return np.ascontiguousarray(_pixels(message, 1, where)[..., 0])
    channels = _CHANNELS.get(encoding, 1 if encoding in _TO_BGR else 0)
    if not channels:
        raise _unknown(where, encoding, "an 8-bit colour encoding")
    if kind != "color":
        raise _unknown(where, encoding, "16UC1 or 32FC1")
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


def _decode_compressed(message: Any, kind: Kind, where: str) -> np.ndarray | Encoded:
    data, form = np.asarray(message.data, np.uint8).tobytes(), str(message.format)
    if "compressedDepth" in form:
        header, data = data[:_COMPRESSED_DEPTH_HEADER], data[_COMPRESSED_DEPTH_HEADER:]
        if "rvl" in form.lower():
            raise _unknown(where, form, "PNG")
        if "32FC1" in form:
            return _inverse_depth(data, header, where)
    elif kind == "depth" and not any(word in form for word in ("16UC1", "mono16", "png", "tiff")):
        raise _unknown(where, form, "16UC1 in PNG")
    for start, suffix in ((b"\xff\xd8", ".jpg"), (b"\x89PNG", ".png")):
        if data.startswith(start):
            return Encoded(data, suffix)
    image = images.decode_image(data, where)
    return images.as_bgr(image) if kind == "color" else image


def _inverse_depth(data: bytes, header: bytes, where: str) -> np.ndarray:
    """Metres of compressed_depth_image_transport's 32FC1: PNG values v of A / z + B, with A and B in the header."""
    values = images.decode_image(data, where)
    if len(header) < _COMPRESSED_DEPTH_HEADER or values.dtype != np.uint16 or values.ndim != 2:
        raise _unknown(where, f"32FC1 in {values.dtype}", "16-bit PNG")
    a, b = struct.unpack_from("<2f", header, 4)
    with np.errstate(all="ignore"):
        depth_m = a / (values.astype(np.float64) - b)
    return np.where((values > 0) & np.isfinite(depth_m) & (depth_m > 0), depth_m, np.nan).astype(np.float32)


def _unknown(where: str, seen: str, needed: str) -> ConfigError:
    return ConfigError(
        f"{where}: encoding {seen[:80]!r} seen, {needed} needed. Convert the topic, or choose another with --topics"
    )

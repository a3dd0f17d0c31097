"""Pixels of the Orbbec SDK's frames, copied out of it."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from rgbd_calib.errors import CalibrationError

_YUV = {"YUYV": cv2.COLOR_YUV2RGB_YUYV, "YUY2": cv2.COLOR_YUV2RGB_YUYV, "UYVY": cv2.COLOR_YUV2RGB_UYVY}
FORMATS = {"color": ("RGB", "BGR", *_YUV, "MJPG"), "depth": ("Y16", "Z16"), "ir": ("Y16", "Y8")}
"""Names of OBFormat that can be read, the best first."""


def color_of(frame: Any, device: str) -> np.ndarray | None:
    """(h, w, 3) uint8, R G B; None for a JPEG that came damaged.

    Raises
    ------
    CalibrationError
        More or fewer bytes than the frame's size needs.
    """
    name, data = frame.get_format().name, np.asarray(frame.get_data(), np.uint8)
    if name == "MJPG":
        bgr = cv2.imdecode(data, cv2.IMREAD_COLOR)
        return None if bgr is None else np.ascontiguousarray(bgr[..., ::-1])
    if name in _YUV:
        return cv2.cvtColor(_shaped(frame, data, 2, device), _YUV[name])
    pixels = _shaped(frame, data, 3, device)
    return pixels.copy() if name == "RGB" else np.ascontiguousarray(pixels[..., ::-1])


def values_of(frame: Any, device: str) -> np.ndarray:
    """(h, w): depth or infrared, uint16, or uint8 where the device has 8 bits.

    Raises
    ------
    CalibrationError
        More or fewer bytes than the frame's size needs.
    """
    data = np.asarray(frame.get_data(), np.uint8)
    if frame.get_format().name == "Y8":
        return _shaped(frame, data, 1, device)[..., 0].copy()
    return _shaped(frame, data, 2, device).copy().view(np.uint16)[..., 0]


def _shaped(frame: Any, data: np.ndarray, channels: int, device: str) -> np.ndarray:
    width, height = frame.get_width(), frame.get_height()
    if data.size != width * height * channels:
        raise CalibrationError(
            f"{device}: a frame of {width}x{height} px in {frame.get_format().name} has {width * height * channels} bytes, "
            f"{data.size} seen. Replug the device"
        )
    return data.reshape(height, width, channels)

"""The C library of the Azure Kinect SDK 1.4, by ctypes; only this module sees it.

The package pyk4a-bundle carries the library; its own binding cannot be imported beside NumPy 2, so only the library is used.
https://microsoft.github.io/Azure-Kinect-Sensor-SDK/master/k4a_8h.html
"""

from __future__ import annotations

import atexit
import ctypes
import importlib.util
import os
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from ctypes import POINTER, byref, c_bool, c_char_p, c_int, c_int32, c_size_t, c_uint32, c_uint64, c_void_p
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

SYSTEM_LIBRARY = "libk4a.so.1.4"
EXPOSURE, WHITE_BALANCE = 0, 6
"""k4a_color_control_command_t: us, K."""
STANDALONE, MASTER, SUBORDINATE = 0, 1, 2
"""k4a_wired_sync_mode_t."""
BGRA32, RES_720P, NFOV_UNBINNED, DEPTH_OFF, FPS_30 = 3, 1, 2, 0, 2
"""Of k4a_image_format_t, k4a_color_resolution_t, k4a_depth_mode_t, k4a_fps_t."""
_AUTO, _MANUAL = 0, 1
_TIMEOUT = 2
_LOG_ERROR, _LOG_OFF = 1, 5
_LOG = ctypes.CFUNCTYPE(None, c_void_p, c_int, c_char_p, c_int, c_char_p)


class K4aError(Exception):
    """The library refused; says the first of the gravest that it logged."""


class Configuration(ctypes.Structure):
    """k4a_device_configuration_t."""

    _fields_ = (
        ("color_format", c_int),
        ("color_resolution", c_int),
        ("depth_mode", c_int),
        ("camera_fps", c_int),
        ("synchronized_images_only", c_bool),
        ("depth_delay_off_color_usec", c_int32),
        ("wired_sync_mode", c_int),
        ("subordinate_delay_off_master_usec", c_uint32),
        ("disable_streaming_indicator", c_bool),
    )


class _Version(ctypes.Structure):
    """k4a_hardware_version_t; only that of the colour camera is read."""

    _fields_ = (("rgb", c_uint32 * 3), ("others", c_uint32 * 9), ("build", c_int), ("signature", c_int))


@dataclass(frozen=True)
class Image:
    """An image, copied out of the library."""

    pixels: np.ndarray
    """Colour (h, w, 4) uint8, B G R A; depth and infrared (h, w) uint16."""
    device_us: int
    exposure_us: int
    white_balance_K: int


@dataclass(frozen=True)
class Capture:
    """What the device exposed at one time; any of it may be lost."""

    color: Image | None
    depth: Image | None
    infrared: Image | None


_DEVICE, _CAPTURE, _IMAGE = c_void_p, c_void_p, c_void_p
_PROTOTYPES: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "device_get_installed_count": (c_uint32, ()),
    "device_open": (c_int, (c_uint32, POINTER(_DEVICE))),
    "device_close": (None, (_DEVICE,)),
    "device_get_serialnum": (c_int, (_DEVICE, c_char_p, POINTER(c_size_t))),
    "device_get_version": (c_int, (_DEVICE, POINTER(_Version))),
    "device_get_raw_calibration": (c_int, (_DEVICE, c_char_p, POINTER(c_size_t))),
    "device_get_sync_jack": (c_int, (_DEVICE, POINTER(c_bool), POINTER(c_bool))),
    "device_get_color_control": (c_int, (_DEVICE, c_int, POINTER(c_int), POINTER(c_int32))),
    "device_set_color_control": (c_int, (_DEVICE, c_int, c_int, c_int32)),
    "device_start_cameras": (c_int, (_DEVICE, POINTER(Configuration))),
    "device_stop_cameras": (None, (_DEVICE,)),
    "device_get_capture": (c_int, (_DEVICE, POINTER(_CAPTURE), c_int32)),
    "capture_release": (None, (_CAPTURE,)),
    "capture_get_color_image": (_IMAGE, (_CAPTURE,)),
    "capture_get_depth_image": (_IMAGE, (_CAPTURE,)),
    "capture_get_ir_image": (_IMAGE, (_CAPTURE,)),
    "image_release": (None, (_IMAGE,)),
    "image_get_buffer": (c_void_p, (_IMAGE,)),
    "image_get_format": (c_int, (_IMAGE,)),
    "image_get_width_pixels": (c_int, (_IMAGE,)),
    "image_get_height_pixels": (c_int, (_IMAGE,)),
    "image_get_stride_bytes": (c_int, (_IMAGE,)),
    "image_get_device_timestamp_usec": (c_uint64, (_IMAGE,)),
    "image_get_exposure_usec": (c_uint64, (_IMAGE,)),
    "image_get_white_balance": (c_uint32, (_IMAGE,)),
    "set_debug_message_handler": (c_int, (_LOG, c_void_p, c_int)),
}


def bundled_library() -> Path | None:
    """The library inside the package pyk4a-bundle, which is not imported."""
    package = importlib.util.find_spec("pyk4a")
    if package is None or package.origin is None:
        return None
    return next(iter(sorted((Path(package.origin).parents[1] / "pyk4a_bundle.libs").glob("libk4a-*.so*"))), None)


def load_library() -> K4a:
    """Raises OSError where there is no library that loads."""
    os.environ.setdefault("K4A_ENABLE_LOG_TO_STDOUT", "0")  # stdout is for results
    bundled = bundled_library()
    if bundled is None:
        return K4a(ctypes.CDLL(SYSTEM_LIBRARY))
    for engine in bundled.parent.glob("libdepthengine.so*"):  # the library looks for it by its name
        with suppress(OSError):  # no OpenGL: the start of the depth camera says so
            ctypes.CDLL(str(engine), mode=ctypes.RTLD_GLOBAL)
    return K4a(ctypes.CDLL(str(bundled)))


class K4a:
    """The library. Devices are opaque handles."""

    def __init__(self, library: Any) -> None:
        self._call: dict[str, Callable[..., Any]] = {}
        for name, (result, arguments) in _PROTOTYPES.items():
            function = getattr(library, f"k4a_{name}")
            function.restype, function.argtypes = result, arguments
            self._call[name] = function
        self._said: deque[tuple[int, str]] = deque(maxlen=20)
        self._log = _LOG(self._remember)
        logging = self._call["set_debug_message_handler"]
        logging(self._log, None, _LOG_ERROR)
        atexit.register(logging, _LOG(), None, _LOG_OFF)  # it must not call into an interpreter that is gone

    def count(self) -> int:
        return int(self._call["device_get_installed_count"]())

    def open(self, index: int) -> Any:
        device = _DEVICE()
        self._check(self._call["device_open"](index, byref(device)))
        return device

    def close(self, device: Any) -> None:
        self._call["device_close"](device)

    def serial(self, device: Any) -> str:
        return self._text("device_get_serialnum", device)

    def firmware(self, device: Any) -> str:
        version = _Version()
        self._check(self._call["device_get_version"](device, byref(version)))
        return ".".join(str(part) for part in version.rgb)

    def calibration(self, device: Any) -> str:
        """JSON, as it is attached to recordings."""
        return self._text("device_get_raw_calibration", device)

    def sync_jacks(self, device: Any) -> tuple[bool, bool]:
        """Is a cable in the jack IN, in the jack OUT?"""
        inward, outward = c_bool(), c_bool()
        self._check(self._call["device_get_sync_jack"](device, byref(inward), byref(outward)))
        return inward.value, outward.value

    def color_control(self, device: Any, command: int) -> tuple[bool, int]:
        """(automatic?, value); the value is valid where it is not automatic."""
        mode, value = c_int(), c_int32()
        self._check(self._call["device_get_color_control"](device, command, byref(mode), byref(value)))
        return mode.value == _AUTO, value.value

    def set_color_control(self, device: Any, command: int, value: int | None) -> None:
        """None: automatic. The device keeps it until it loses power."""
        mode = _AUTO if value is None else _MANUAL
        self._check(self._call["device_set_color_control"](device, command, mode, value or 0))

    def start(self, device: Any, configuration: Configuration) -> None:
        self._check(self._call["device_start_cameras"](device, byref(configuration)))

    def stop(self, device: Any) -> None:
        self._call["device_stop_cameras"](device)

    def capture(self, device: Any, timeout_ms: int) -> Capture | None:
        """None where none comes in time; K4aError where the device is gone."""
        handle = _CAPTURE()
        result = self._call["device_get_capture"](device, byref(handle), timeout_ms)
        if result == _TIMEOUT:
            return None
        self._check(result)
        return self.copied(handle)

    def copied(self, handle: Any) -> Capture:
        """The images of a capture's handle, which is released."""
        try:
            images = [self._image(self._call[f"capture_get_{kind}_image"](handle)) for kind in ("color", "depth", "ir")]
        finally:
            self._call["capture_release"](handle)
        return Capture(*images)

    def _image(self, handle: Any) -> Image | None:
        if not handle:
            return None

        def ask(what: str) -> int:
            return int(self._call[f"image_get_{what}"](handle))

        try:
            width, height, stride = ask("width_pixels"), ask("height_pixels"), ask("stride_bytes")
            raw = np.ctypeslib.as_array((ctypes.c_uint8 * (height * stride)).from_address(ask("buffer")))
            if ask("format") == BGRA32:
                pixels = raw.reshape(height, stride)[:, : 4 * width].reshape(height, width, 4).copy()
            else:
                pixels = raw.reshape(height, stride)[:, : 2 * width].copy().view(np.uint16)
            return Image(pixels, ask("device_timestamp_usec"), ask("exposure_usec"), ask("white_balance"))
        finally:
            self._call["image_release"](handle)

    def _text(self, name: str, device: Any) -> str:
        size = c_size_t(0)
        self._call[name](device, None, byref(size))
        text = ctypes.create_string_buffer(max(size.value, 1))
        self._check(self._call[name](device, text, byref(size)))
        return text.value.decode("utf-8", "replace")

    def _check(self, result: int) -> None:
        said = list(self._said)
        self._said.clear()
        if result != 0:
            raise K4aError(min(said, key=lambda one: one[0])[1] if said else "it gives no reason")

    def _remember(self, _context: int, level: int, _file: bytes, _line: int, message: bytes) -> None:
        self._said.append((level, message.decode("utf-8", "replace")))

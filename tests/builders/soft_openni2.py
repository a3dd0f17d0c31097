"""OpenNI2 cameras without hardware: the stock runtime with the virtual driver, whose frames are sent by hand."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from soft_cameras import SoftCamera

from rgbd_calib.sensors.openni2 import Runtime, load_runtime

SERIALS = ("111", "222", "333")
KINDS = ("color", "depth")
_loaded: list[tuple[Path, ctypes.CDLL]] = []
"""The folder and the library: at most one in a process, as the runtime."""


class SoftOpenNi2(SoftCamera):
    """OpenNI2 states no lens, cameras register depth to colour themselves, and are found by their place on the USB."""

    sizes: ClassVar = {"color": (640, 480), "depth": (640, 480)}
    unit_m = 0.001
    prefix = "virtual://"
    states_geometry = False
    synchronises = False

    def __init__(self, serial: str, cable: bool = False, depth: bool = True) -> None:
        super().__init__(serial, depth)
        self.number = SERIALS.index(serial)
        _library().vxtion_lock_exposure(self.number)
        _library().vxtion_set_depth(self.number, depth)

    def is_at(self, uri: str) -> bool:
        return uri == f"{self.prefix}{self.number}"

    @property
    def automatic(self) -> tuple[bool, bool]:
        bits = _library().vxtion_automatic(self.number)
        return bool(bits & 1), bool(bits & 2)

    @property
    def sync_place(self) -> None:
        return None

    def deliver(self, frames: dict, device_us: int, number: int) -> None:
        for kind, pixels in frames.items():
            height, width = pixels.shape[:2]
            data = np.ascontiguousarray(pixels).ctypes.data_as(ctypes.c_void_p)
            stamp = ctypes.c_uint64(device_us)
            _library().vxtion_send(self.number, KINDS.index(kind), data, width, height, stamp)

    @staticmethod
    def driver(attached: list[SoftOpenNi2]) -> Runtime:
        _plug(attached)
        return _Attached(load_runtime(_loaded[0][0]), attached)


class _Attached:
    """The runtime; who looks for devices finds those of a list plugged in, and no others."""

    def __init__(self, runtime: Runtime, attached: list[SoftOpenNi2]) -> None:
        self._runtime, self._attached = runtime, attached

    def uris(self) -> list[str]:
        _plug(self._attached)
        return self._runtime.uris()

    def __getattr__(self, name: str):
        return getattr(self._runtime, name)


def _plug(attached: list[SoftOpenNi2]) -> None:
    for number in range(len(SERIALS)):
        _library().vxtion_plug(number, any(camera.number == number for camera in attached))


def use(redist: Path) -> type[SoftOpenNi2]:
    """The class, once its virtual driver is loaded from a folder that `build_redist` made: the library that the runtime loads."""
    if not _loaded:
        settings = {"BY_HAND": "1", "DEVICES": str(len(SERIALS)), "SERIALS": ",".join(SERIALS)}
        with pytest.MonkeyPatch.context() as patch:  # other virtual cameras start from this environment
            for name, value in settings.items():
                patch.setenv(f"VXTION_{name}", value)
            library = ctypes.CDLL(str(redist / "OpenNI2" / "Drivers" / "libVirtualXtion.so.0"))
            library.vxtion_automatic(0)  # reads the environment
        _loaded.append((redist, library))
    return SoftOpenNi2


def _library() -> ctypes.CDLL:
    return _loaded[0][1]

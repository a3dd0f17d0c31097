"""The OpenNI2 runtime: found, started, and unloaded in an order that it survives.

A second attempt to start it in one process fails, closing handles under a thread that reads crashes, and so does the
binding's own clean-up at exit; so there is one `Runtime`, with a hook that closes in the right order first.
"""

from __future__ import annotations

import atexit
import os
import sys
import sysconfig
from pathlib import Path
from typing import Any

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.sensors.openni2_device import OpenNi2Device, reason

_LIBRARIES = ("libOpenNI2.so", "libOpenNI2.so.0", "libOpenNI2.dylib", "OpenNI2.dll")


class Runtime:
    """The OpenNI2 runtime of this process; there is only one."""

    def __init__(self, binding: Any, folder: Path) -> None:
        self._binding = binding
        self.folder = folder
        self._devices: list[OpenNi2Device] = []
        self._abandoned = False
        atexit.register(self.close)  # runs before the binding's own hook, which would close under our feet

    @property
    def version(self) -> str:
        v = self._binding.get_version()
        return f"{v.major}.{v.minor}.{v.maintenance}.{v.build}"

    @property
    def label(self) -> str:
        return f"OpenNI2 {self.version} in {self.folder}"

    def permission(self, uri: str) -> str:
        return "Install libopenni2-0 (it brings udev rules for these cameras)"

    def owns(self, uri: str) -> bool:
        return not uri.startswith(("realsense:", "azure:", "orbbec:", "replay:"))

    def uris(self) -> list[str]:
        """Devices that are attached now."""
        return [uri.decode() for uri in self._binding.Device.enumerate_uris()]

    def open(self, uri: str) -> OpenNi2Device:
        """Open a device or a recorded file by its uri.

        Raises
        ------
        CalibrationError
            The device does not open.
        """
        try:
            device = OpenNi2Device(self._binding, self._binding.Device(uri.encode()))
        except self._binding.OpenNIError as error:
            if uri not in self.uris() and not Path(uri).exists():
                raise CalibrationError(f"{uri}: the device is no longer attached. Plug it in again") from None
            raise CalibrationError(
                f"{uri}: the device does not open ({reason(error)}). It must be free and reachable: close other programs "
                "that use it, replug it, check the udev rules of libopenni2-0, and give it a USB 2.0 controller of its own"
            ) from None
        self._devices.append(device)
        return device

    def abandon(self) -> None:
        """Leave every handle as it is, for ever: a thread hangs in the runtime and closing would crash."""
        self._abandoned = True
        self._binding._openni2_initialized = False  # the binding's handles now close without calling the runtime

    def close(self) -> None:
        """Close all devices and unload the runtime; calling it twice does nothing."""
        if self._abandoned or not self._binding.is_initialized():
            return
        for device in self._devices:
            device.close()
        self._devices.clear()
        self._binding.unload()


def load_runtime(redist: Path | None = None) -> Runtime:
    """Find and start the runtime: `redist`, else where OPENNI2_REDIST64 says, else Debian's and the usual folders.

    Raises
    ------
    ConfigError
        No binding for this Python, no runtime, no driver.
    """
    if sys.version_info >= (3, 13):
        raise ConfigError(
            f"Python {sys.version_info.major}.{sys.version_info.minor} runs this program; the OpenNI2 binding works up to "
            "3.12 only. Install rgbd-calib under Python 3.10-3.12 for `devices` and `capture`; all else works here"
        )
    try:
        from openni import openni2 as binding
    except ImportError:
        raise ConfigError("the package `openni` is not installed; cameras need it. `pip install openni`") from None
    folder, library = find_library(redist)
    binding._dll_name = library
    try:
        binding.initialize(str(folder))
    except Exception as error:  # the binding raises what the loader or the runtime raised, of any type
        raise ConfigError(
            f"{folder / library}: the OpenNI2 runtime does not start ({' '.join(str(error).split())}). It needs drivers in "
            f"{folder}/OpenNI2/Drivers: `apt-get install libopenni2-0`, or name another folder with --redist"
        ) from None
    return Runtime(binding, folder)


def find_library(redist: Path | None) -> tuple[Path, str]:
    asked = redist or os.environ.get("OPENNI2_REDIST64") or os.environ.get("OPENNI2_REDIST")
    multiarch = sysconfig.get_config_var("MULTIARCH") or "x86_64-linux-gnu"
    usual = [f"/usr/lib/{multiarch}", "/usr/lib", "/usr/local/lib", "/lib64", "/usr/lib64"]
    folders = [Path(asked)] if asked else [Path(f) for f in usual]
    for folder in folders:
        for library in _LIBRARIES:
            if (folder / library).is_file():
                return folder.absolute(), library
    looked = ", ".join(str(f) for f in folders)
    raise ConfigError(
        f"no OpenNI2 runtime (looked for {_LIBRARIES[1]} in {looked}). It drives the cameras: "
        "`apt-get install libopenni2-0`, or name its folder with --redist or OPENNI2_REDIST64"
    )

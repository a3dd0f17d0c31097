"""What the program needs of cameras of any make: a driver finds and opens devices, a device delivers frames.

A driver is one module. `capture` and `devices` use these interfaces only, so that a rig may have cameras of several makes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.dataset import CameraInfo
from rgbd_calib.sensors.frames import Kind, SensorFrame
from rgbd_calib.sensors.usb import UsbPlace

DRIVERS = ("openni2", "realsense", "azure", "orbbec", "replay:RECORDING")


@dataclass(frozen=True)
class DeviceSettings:
    """What a device says of itself and of its streams, read back after it was set up."""

    uri: str
    name: str
    vendor: str
    serial: str | None
    firmware: str | None
    usb_path: str | None
    usb_controller: str | None
    color_mode: str
    depth_mode: str | None
    """None: colour alone."""
    registered: bool
    mirrored: bool
    horizontal_fov_rad: float
    vertical_fov_rad: float

    @classmethod
    def of(
        cls,
        device: Device,
        color_mode: str,
        depth_mode: str | None,
        fov_rad: tuple[float, float],
        *,
        place: UsbPlace | None = None,
        registered: bool = False,
        mirrored: bool = False,
    ) -> DeviceSettings:
        """With what an open device says of itself; `place` is where it hangs on the USB, None where that is not known."""
        return cls(
            device.uri,
            device.name,
            device.vendor,
            device.serial,
            device.firmware,
            place.path if place else None,
            place.controller if place else None,
            color_mode,
            depth_mode,
            registered,
            mirrored,
            *fov_rad,
        )


def field_of_view_rad(size_px: tuple[int, int], focal_px: Sequence[float]) -> tuple[float, float]:
    """Across and down; 0 where the focal length is not known."""
    across, down = (2 * math.atan(n / 2 / f) if f else 0.0 for n, f in zip(size_px, focal_px, strict=True))
    return across, down


def kinds_of(color_only: bool) -> tuple[Kind, ...]:
    """What a device delivers."""
    return ("color",) if color_only else ("depth", "color")


class Device(Protocol):
    """An open device with one colour and one depth stream, or colour alone."""

    uri: str
    """By which its driver opens it again."""
    name: str
    vendor: str
    serial: str | None
    firmware: str | None

    @property
    def usb_path(self) -> str:
        """The port it hangs on; its uri where the port is not known."""

    @property
    def label(self) -> str:
        """How messages name it."""

    @property
    def sizes(self) -> dict[Kind, tuple[int, int]]:
        """Of a configured device: (width, height) of its frames, px; without depth where it gives colour alone."""

    def modes(self) -> list[str]:
        """Video modes of both streams, such as `color 640x480@30 RGB888`."""

    def configure(self, allow_unregistered: bool = False, color_only: bool = False) -> DeviceSettings:
        """Choose modes and set them; CalibrationError where the device refuses what a calibration needs. Colour alone where that
        is asked for, or the device has no depth sensor."""

    def set_sync(self, place: int) -> bool:
        """Before the start: give the pulse of a cable that joins the cameras (place 0) or follow it; False where there is no
        such mode, or no cable. Lasers that disturb each other take turns by their places."""

    def describe(self) -> CameraInfo:
        """Of a device that delivers: sizes, unit of depth, and the geometry as far as the device states it."""

    def start(self) -> None:
        """Start the streams, exposure and white balance automatic; CalibrationError where the device refuses."""

    def wait_frame(self, timeout_s: float) -> SensorFrame | None:
        """The next frame of any stream, copied; None where none comes in time. Called from one thread only."""

    def lock_exposure(self) -> bool:
        """Freeze exposure and white balance as they are now; False where the camera does not take it."""

    def camera_settings(self) -> dict[str, Any]:
        """Exposure and white balance as the camera reports them."""

    def set_emitter(self, on: bool) -> None:
        """Switch the infrared projector; CalibrationError where there is no such switch."""

    def close(self) -> None:
        """Stop and close. No thread may be reading; calling it twice does nothing."""


class Driver(Protocol):
    """The devices of one make, as long as the program runs."""

    @property
    def label(self) -> str:
        """The driver's name and version."""

    def permission(self, uri: str) -> str:
        """What lets this user use a device that the system keeps from them."""

    def uris(self) -> list[str]:
        """Devices that are attached now, also those that do not open."""

    def owns(self, uri: str) -> bool:
        """True for the uris of this driver's devices."""

    def open(self, uri: str) -> Device:
        """Open a device; CalibrationError where it does not open."""

    def abandon(self) -> None:
        """Leave every handle as it is, for ever: a thread hangs in the runtime and closing would crash."""

    def close(self) -> None:
        """Close all devices; calling it twice does nothing."""


class OpenedDevices:
    """What a driver does with the devices that it has opened, whose uris begin with `prefix`."""

    prefix: ClassVar[str]

    def __init__(self) -> None:
        self._opened: list[Device] = []

    def owns(self, uri: str) -> bool:
        return uri.startswith(self.prefix)

    def abandon(self) -> None:
        self._opened.clear()

    def close(self) -> None:
        for device in self._opened:
            device.close()
        self._opened.clear()


class Drivers:
    """Several drivers as one."""

    def __init__(self, drivers: Sequence[Driver], missing: Sequence[str] = ()) -> None:
        self._drivers = tuple(drivers)
        self.missing = tuple(missing)
        """Why others could not be loaded."""

    @property
    def label(self) -> str:
        return ", ".join(driver.label for driver in self._drivers) or "no driver"

    def uris(self) -> list[str]:
        return [uri for driver in self._drivers for uri in driver.uris()]

    def owns(self, uri: str) -> bool:
        return any(driver.owns(uri) for driver in self._drivers)

    def permission(self, uri: str) -> str:
        return self._of(uri).permission(uri)

    def open(self, uri: str) -> Device:
        return self._of(uri).open(uri)

    def abandon(self) -> None:
        for driver in self._drivers:
            driver.abandon()

    def close(self) -> None:
        for driver in self._drivers:
            driver.close()

    def _of(self, uri: str) -> Driver:
        return next(driver for driver in self._drivers if driver.owns(uri))


def load_drivers(names: Sequence[str], redist: Path | None) -> Drivers:
    """The drivers asked for (see `DRIVERS`), or all whose software is installed.

    Raises
    ------
    ConfigError
        An unknown name, or a driver that was asked for and cannot be loaded.
    """
    loaders: dict[str, Callable[[], Driver]] = {
        "openni2": lambda: _openni2(redist),
        "realsense": _realsense,
        "azure": _azure,
        "orbbec": _orbbec,
    }
    if names:
        return Drivers([_load(name, loaders) for name in dict.fromkeys(names)])
    drivers: list[Driver] = []
    missing = []
    for name, load in loaders.items():
        try:
            drivers.append(load())
        except ConfigError as error:
            if name == "openni2" and redist is not None:
                raise
            missing.append(str(error))
    return Drivers(drivers, missing)


def _load(name: str, loaders: dict[str, Callable[[], Driver]]) -> Driver:
    kind, _, rest = name.partition(":")
    if kind == "replay" and rest:
        from rgbd_calib.sensors.replay import Replay

        return Replay(Path(rest))
    if name not in loaders:
        raise ConfigError(f"--driver {name}: one of {', '.join(DRIVERS)} needed")
    return loaders[name]()


def _openni2(redist: Path | None) -> Driver:
    from rgbd_calib.sensors.openni2 import load_runtime

    return load_runtime(redist)


def _realsense() -> Driver:
    from rgbd_calib.sensors.realsense import load_realsense

    return load_realsense()


def _azure() -> Driver:
    from rgbd_calib.sensors.azure_kinect import load_azure

    return load_azure()


def _orbbec() -> Driver:
    from rgbd_calib.sensors.orbbec import load_orbbec

    return load_orbbec()

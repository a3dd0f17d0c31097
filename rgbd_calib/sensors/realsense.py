"""RealSense cameras by librealsense (`pip install 'rgbd-calib[realsense]'`); only this module sees the binding.

Depth is taken as the device measures it, in its own geometry, with the factory's lenses and extrinsics beside it: alignment
to colour in software would leave holes and move depth over edges.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.calibrations.makers_lens import lens_of_maker
from rgbd_calib.io.dataset import CameraInfo, DepthGeometry
from rgbd_calib.sensors.driver import Device, DeviceSettings, OpenedDevices, field_of_view_rad, kinds_of
from rgbd_calib.sensors.frames import Kind, SensorFrame
from rgbd_calib.sensors.usb import UsbPlace

WIDTH, HEIGHT, FPS = 640, 480, 30
_PREFIX = "realsense:"
_LEADS, _FOLLOWS = 1.0, 2.0
"""RS2_OPTION_INTER_CAM_SYNC_MODE: master, slave."""
_QUEUE = 32
"""Frames of both streams that wait for the reader: half a second."""


def load_realsense() -> RealSense:
    """The driver with all devices that are attached.

    Raises
    ------
    ConfigError
        The binding is not installed, or does not start.
    """
    try:
        import pyrealsense2 as binding
    except ImportError:
        raise ConfigError(
            "RealSense cameras: the package `pyrealsense2` is not installed. `pip install 'rgbd-calib[realsense]'`"
        ) from None
    try:
        context = binding.context()
    except RuntimeError as error:
        raise ConfigError(
            f"RealSense cameras: librealsense does not start ({_words(error)}). Reinstall pyrealsense2"
        ) from None
    return RealSense(binding, context.query_devices)


class RealSense(OpenedDevices):
    """The driver.

    Parameters
    ----------
    devices
        Gives the devices that are attached now.
    """

    prefix = _PREFIX

    def __init__(self, binding: Any, devices: Callable[[], Iterable[Any]]) -> None:
        self._binding = binding
        self._devices = devices
        super().__init__()

    @property
    def label(self) -> str:
        return f"librealsense {getattr(self._binding, '__version__', '')}".rstrip()

    def uris(self) -> list[str]:
        return [_PREFIX + serial for serial in self._attached()]

    def permission(self, uri: str) -> str:
        return "Install librealsense's udev rules (99-realsense-libusb.rules)"

    def open(self, uri: str) -> Device:
        handle = self._attached().get(uri.removeprefix(_PREFIX))
        if handle is None:
            raise CalibrationError(f"{uri}: the device is no longer attached. Plug it in again")
        device = RealSenseDevice(self._binding, handle, uri)
        self._opened.append(device)
        return device

    def _attached(self) -> dict[str, Any]:
        """Devices by serial number; the number is unique over librealsense's makes."""
        found = {}
        for handle in self._devices():
            serial = _info(self._binding, handle, "serial_number")
            if serial is not None:
                found[serial] = handle
        return found


class RealSenseDevice:
    """One camera: its colour and its depth stream, each of a sensor of its own, or its colour alone."""

    vendor = "Intel RealSense"

    def __init__(self, binding: Any, handle: Any, uri: str) -> None:
        self._binding, self._handle, self.uri = binding, handle, uri
        self.name: str = _info(binding, handle, "name") or "RealSense"
        self.serial: str | None = _info(binding, handle, "serial_number")
        self.firmware: str | None = _info(binding, handle, "firmware_version")
        self._port = _info(binding, handle, "physical_port")
        self._profiles: dict[Kind, Any] = {}
        self._sensors: dict[Kind, Any] = {}
        self._queue: Any = None

    @property
    def usb_path(self) -> str:
        return self._port or self.uri

    @property
    def label(self) -> str:
        return f"{self.uri} ({self.name})"

    @property
    def sizes(self) -> dict[Kind, tuple[int, int]]:
        videos = {kind: profile.as_video_stream_profile() for kind, profile in self._profiles.items()}
        return {kind: (video.width(), video.height()) for kind, video in videos.items()}

    def modes(self) -> list[str]:
        modes = (_mode(profile) for _, _, profile in self._streams())
        return list(dict.fromkeys(modes))

    def configure(self, allow_unregistered: bool = False, color_only: bool = False) -> DeviceSettings:
        """640x480 at 30 fps where there is such a mode, else the largest at 30 fps.

        Raises
        ------
        CalibrationError
            No colour or no depth stream at 30 fps.
        """
        for kind in kinds_of(color_only or all(kind != "depth" for kind, _, _ in self._streams())):
            able = [(s, p) for k, s, p in self._streams() if k == kind and p.fps() == FPS]
            if not able:
                raise CalibrationError(
                    f"{self.label}: a {kind} stream at {FPS} fps needed, {', '.join(self.modes()) or 'none'} found. Use a USB 3 "
                    "port and cable"
                )
            self._sensors[kind], self._profiles[kind] = max(able, key=lambda one: _preference(one[1]))
        lens = self._profiles["color"].as_video_stream_profile().get_intrinsics()
        fov = field_of_view_rad((lens.width, lens.height), (lens.fx, lens.fy))
        modes = {kind: _mode(profile).split(" ", 1)[1] for kind, profile in self._profiles.items()}
        return DeviceSettings.of(
            self,
            modes["color"],
            modes.get("depth"),
            fov,
            place=None if self._port is None else UsbPlace(self._port, None),
        )

    def set_sync(self, place: int) -> bool:
        if "depth" not in self._sensors:  # its exposures are what the pulse starts
            return False
        sensor, mode = self._sensors["depth"], self._binding.option.inter_cam_sync_mode
        wanted = _LEADS if place == 0 else _FOLLOWS
        try:
            sensor.set_option(mode, wanted)
            return bool(sensor.get_option(mode) == wanted)
        except RuntimeError:  # a camera without the mode
            return False

    def describe(self) -> CameraInfo:
        color = self._profiles["color"].as_video_stream_profile()
        if "depth" not in self._profiles:
            lens = self._lens(color, "color")
            return CameraInfo(color.width(), color.height(), serial=self.serial, intrinsics=lens)
        depth = self._profiles["depth"].as_video_stream_profile()
        extrinsics = depth.get_extrinsics_to(color)
        R = np.array(extrinsics.rotation).reshape(3, 3).T  # librealsense writes columns
        T_color_depth = se3.make(R, np.array(extrinsics.translation))
        geometry = DepthGeometry(depth.width(), depth.height(), self._lens(depth, "depth"), None, T_color_depth)
        units = self._binding.option.depth_units
        scale = self._sensors["depth"].get_option(units) if self._sensors["depth"].supports(units) else 0.001
        return CameraInfo(
            color.width(),
            color.height(),
            round(float(scale), 9),
            self.serial,
            self._lens(color, "color"),
            geometry,
            depth_stated=True,
        )

    def start(self) -> None:
        option = self._binding.option
        for automatic in (option.enable_auto_exposure, option.enable_auto_white_balance):
            with suppress(RuntimeError):  # a camera without; a value of an earlier session may stand
                self._sensors["color"].set_option(automatic, 1.0)
        self._queue = self._binding.frame_queue(_QUEUE, True)
        try:
            for sensor, profiles in self._by_sensor():
                sensor.open(profiles)
                sensor.start(self._queue)
        except RuntimeError as error:
            raise CalibrationError(
                f"{self.label}: the streams do not start ({_words(error)}). Close other programs that use the camera; if "
                "permission is denied, install librealsense's udev rules (99-realsense-libusb.rules) and replug it"
            ) from None

    def wait_frame(self, timeout_s: float) -> SensorFrame | None:
        came, frame = self._queue.try_wait_for_frame(int(1000 * timeout_s))
        if not came:
            return None
        arrival_s = time.monotonic()
        kind: Kind = "depth" if frame.is_depth_frame() else "color"
        pixels = np.array(np.asanyarray(frame.get_data()))
        if frame.profile.format() == self._binding.format.bgr8:
            pixels = np.ascontiguousarray(pixels[..., ::-1])
        return SensorFrame(kind, pixels, round(1000 * frame.get_timestamp()), int(frame.get_frame_number()), arrival_s)

    def lock_exposure(self) -> bool:
        option = self._binding.option
        locked = []
        for automatic, value in (
            (option.enable_auto_exposure, option.exposure),
            (option.enable_auto_white_balance, option.white_balance),
        ):
            sensor = self._sensors["color"]
            try:
                now = sensor.get_option(value)
                sensor.set_option(automatic, 0.0)
                sensor.set_option(value, now)
                locked.append(sensor.get_option(automatic) == 0.0)
            except RuntimeError:
                locked.append(False)
        return all(locked)

    def camera_settings(self) -> dict[str, Any]:
        sensor, option = self._sensors["color"], self._binding.option
        wanted = {
            "auto_exposure": option.enable_auto_exposure,
            "auto_white_balance": option.enable_auto_white_balance,
            "exposure": option.exposure,
            "gain": option.gain,
        }
        return {name: float(sensor.get_option(one)) for name, one in wanted.items() if sensor.supports(one)}

    def set_emitter(self, on: bool) -> None:
        sensor, emitter = self._sensors["depth"], self._binding.option.emitter_enabled
        if not sensor.supports(emitter):
            raise CalibrationError(
                f"{self.label}: its infrared projector cannot be switched. Leave out --alternate-emitters"
            )
        sensor.set_option(emitter, float(on))

    def close(self) -> None:
        if self._queue is None:
            return
        for sensor, _ in self._by_sensor():
            try:
                sensor.stop()
                sensor.close()
            except RuntimeError:
                pass  # unplugged
        self._queue = None

    def _by_sensor(self) -> list[tuple[Any, list[Any]]]:
        """A sensor may have both streams; it is opened once."""
        if self._sensors.get("depth") is self._sensors["color"]:
            return [(self._sensors["depth"], [self._profiles["depth"], self._profiles["color"]])]
        return [(sensor, [self._profiles[kind]]) for kind, sensor in self._sensors.items()]

    def _streams(self) -> list[tuple[Kind, Any, Any]]:
        """All modes that can be used."""
        b = self._binding
        formats: dict[Any, tuple[Kind, tuple[Any, ...]]] = {
            b.stream.color: ("color", (b.format.rgb8, b.format.bgr8)),
            b.stream.depth: ("depth", (b.format.z16,)),
        }
        found = []
        for sensor in self._handle.query_sensors():
            for profile in sensor.get_stream_profiles():
                kind, usable = formats.get(profile.stream_type(), (None, ()))
                if kind is not None and profile.format() in usable and profile.is_video_stream_profile():
                    found.append((kind, sensor, profile))
        return found

    def _lens(self, profile: Any, kind: str) -> Intrinsics:
        own = profile.get_intrinsics()
        found, _ = lens_of_maker(
            Path(self.uri),
            kind,
            (own.width, own.height),
            (own.fx, own.fy),
            (own.ppx, own.ppy),
            str(own.model),
            list(own.coeffs),
        )
        return found


def _preference(profile: Any) -> tuple[bool, int, bool]:
    video = profile.as_video_stream_profile()
    usual = (video.width(), video.height()) == (WIDTH, HEIGHT)
    return usual, video.width() * video.height(), "rgb" in str(profile.format())


def _mode(profile: Any) -> str:
    video = profile.as_video_stream_profile()
    name = str(profile.format()).rpartition(".")[2].upper()
    kind = str(profile.stream_type()).rpartition(".")[2]
    return f"{kind} {video.width()}x{video.height()}@{profile.fps()} {name}"


def _info(binding: Any, handle: Any, name: str) -> str | None:
    key = getattr(binding.camera_info, name)
    return str(handle.get_info(key)) if handle.supports(key) else None


def _words(error: Exception) -> str:
    return " ".join(str(error).split())

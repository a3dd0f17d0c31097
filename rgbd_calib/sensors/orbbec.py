"""Orbbec cameras (Femto, Gemini, Astra) by the package pyorbbecsdk2; only this module sees the binding.

Depth is taken as the device measures it, in its own geometry, with the factory's lenses and extrinsics beside it; depth
cameras that measure time of flight give their infrared image too. The binding itself needs NumPy only: the other packages
that it asks for, at versions that exclude those of this program, are those of its examples.
"""

from __future__ import annotations

import os
import re
import sys
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.calibrations.common import rigid
from rgbd_calib.io.calibrations.makers_lens import lens_of_maker
from rgbd_calib.io.dataset import CameraInfo, DepthGeometry
from rgbd_calib.sensors.driver import Device, DeviceSettings, OpenedDevices, field_of_view_rad, kinds_of
from rgbd_calib.sensors.frames import Kind, SensorFrame
from rgbd_calib.sensors.orbbec_frames import FORMATS, color_of, values_of
from rgbd_calib.sensors.usb import forbidden_node, usb_devices, usb_place

WIDTH, HEIGHT, FPS = 640, 480, 30
MOST_COLOR_PX = 1280 * 960
"""Of cameras without a 640x480 mode: 4K at 30 fps is more than a computer decodes for a rig."""
_PREFIX, _VENDOR = "orbbec:", "2bc5"
_UID = re.compile(r"(\d+)-[\d.]*-(\d+)")
"""Bus, ports, address: of a device on the USB under Linux."""
_LASER_SLOT_US = 160
"""Between the lasers of two time-of-flight cameras on one cable, as Azure Kinect's, which Femto has inside."""


def load_orbbec() -> OrbbecCameras:
    """The driver.

    Raises
    ------
    ConfigError
        The binding is not installed, or does not start.
    """
    try:
        with _silent():
            import pyorbbecsdk as binding
    except ImportError as error:
        raise ConfigError(
            f"Orbbec cameras: the package `pyorbbecsdk2` does not load ({error}). `pip install --no-deps pyorbbecsdk2`"
        ) from None
    binding.Context.set_logger_level(binding.OBLogLevel.NONE)  # it would make a folder Log where the user is
    try:
        return OrbbecCameras(binding, binding.Context())
    except binding.OBError as error:
        raise ConfigError(
            f"Orbbec cameras: the Orbbec SDK does not start ({_words(error)}). Reinstall pyorbbecsdk2"
        ) from None


class OrbbecCameras(OpenedDevices):
    """The driver."""

    prefix = _PREFIX

    def __init__(self, binding: Any, context: Any) -> None:
        self._binding, self._context = binding, context
        super().__init__()

    @property
    def label(self) -> str:
        return f"Orbbec SDK {self._binding.get_version()}"

    def permission(self, uri: str) -> str:
        return f"Run `sudo sh {Path(self._binding.__file__).parent}/shared/install_udev_rules.sh`"

    def uris(self) -> list[str]:
        """The SDK passes over devices that it may not open; the kernel lists them."""
        devices = self._context.query_devices()
        found = []
        for i in range(devices.get_count()):
            address = _UID.fullmatch(devices.get_device_uid_by_index(i))
            where = f"@{address[1]}/{address[2]}" if address else ""
            found.append(f"{_PREFIX}{devices.get_device_serial_number_by_index(i)}{where}")
        others = [f"{_PREFIX}{device.serial}@{device.address}" for device in usb_devices(_VENDOR)]
        return [*found, *(uri for uri in others if uri not in found and forbidden_node(uri))]

    def open(self, uri: str) -> Device:
        serial = uri.removeprefix(_PREFIX).partition("@")[0]
        try:
            handle = self._context.query_devices().get_device_by_serial_number(serial)
            device = OrbbecCamera(self._binding, handle, uri)
        except self._binding.OBError as error:
            raise CalibrationError(
                f"{uri}: the device does not open ({_words(error)}). Close other programs that use it, and replug it. If "
                f"permission is denied: {self.permission(uri)}"
            ) from None
        self._opened.append(device)
        return device


class OrbbecCamera:
    """One camera: its colour, depth and, of time of flight, infrared sensor."""

    vendor = "Orbbec"

    def __init__(self, binding: Any, handle: Any, uri: str) -> None:
        self._binding, self._handle, self.uri = binding, handle, uri
        info = handle.get_device_info()
        self.name: str = info.get_name()
        self.serial: str | None = info.get_serial_number() or None
        self.firmware: str | None = info.get_firmware_version()
        self._place = usb_place(uri)
        self._profiles: dict[str, Any] = {}
        self._pipeline: Any = None
        self._sync_before: Any = None
        self._unit_mm: float | None = None
        self._ready: deque[SensorFrame] = deque()

    @property
    def usb_path(self) -> str:
        return self._place.path if self._place else self.uri

    @property
    def label(self) -> str:
        return f"{self.uri} ({self.name})"

    @property
    def sizes(self) -> dict[Kind, tuple[int, int]]:
        return {kind: _size(self._profiles[kind]) for kind in kinds_of("depth" not in self._profiles)}

    def modes(self) -> list[str]:
        return list(dict.fromkeys(_mode(kind, p) for kind in ("color", "depth") for p in self._offered(kind)))

    def configure(self, allow_unregistered: bool = False, color_only: bool = False) -> DeviceSettings:
        """640x480 at 30 fps where there is such a mode, else the largest at 30 fps, of colour up to 1280x960.

        Raises
        ------
        CalibrationError
            No colour or no depth stream at 30 fps, or pictures that stay mirrored.
        """
        for kind in kinds_of(color_only or not self._offered("depth")):
            able = [p for p in self._offered(kind) if p.get_fps() == FPS]
            if not able:
                raise CalibrationError(
                    f"{self.label}: a {kind} stream at {FPS} fps needed, {', '.join(self.modes()) or 'none'} found. Use a USB 3 "
                    "port and cable"
                )
            self._profiles[kind] = max(able, key=lambda p: _preference(kind, p))
        size = self.sizes.get("depth")
        infrared = [p for p in self._offered("ir") if p.get_fps() == FPS and _size(p) == size]
        if infrared:
            self._profiles["ir"] = max(infrared, key=lambda p: _preference("ir", p))
        if self._stays_mirrored():
            raise CalibrationError(
                f"{self.label}: pictures stay mirrored after mirroring was switched off; a calibration needs them as seen. "
                "Replug the device, or update its firmware"
            )
        lens = self._profiles["color"].get_intrinsic()
        fov = field_of_view_rad((lens.width, lens.height), (lens.fx, lens.fy))
        modes = {kind: _mode(kind, self._profiles[kind]).split(" ", 1)[1] for kind in self.sizes}
        return DeviceSettings.of(self, modes["color"], modes.get("depth"), fov, place=self._place)

    def set_sync(self, place: int) -> bool:
        modes = self._binding.OBMultiDeviceSyncMode
        wanted = [modes.PRIMARY] if place == 0 else [modes.SECONDARY_SYNCED, modes.SECONDARY]
        try:
            bits = self._handle.get_supported_multi_device_sync_mode_bitmap()
            mode = next((m for m in wanted if int(m) & bits), None)
            if mode is None:
                return False
            self._sync_before = self._handle.get_multi_device_sync_config()
            setup = self._handle.get_multi_device_sync_config()
            setup.mode, setup.trigger_out_enable = mode, True
            setup.trigger_to_image_delay_us = place * _LASER_SLOT_US
            self._handle.set_multi_device_sync_config(setup)
            return bool(self._handle.get_multi_device_sync_config().mode == mode)
        except self._binding.OBError:
            return False

    def describe(self) -> CameraInfo:
        if "depth" not in self._profiles:
            return CameraInfo(*self.sizes["color"], serial=self.serial, intrinsics=self._lens("color"))
        if self._unit_mm is None:
            raise CalibrationError(
                f"{self.label}: no depth frame came, so that its unit is not known. Replug the device"
            )
        color, depth = self._profiles["color"], self._profiles["depth"]
        try:
            own = depth.get_extrinsic_to(color)
            R, t_mm = np.asarray(own.rot, float).reshape(3, 3), np.asarray(own.transform, float)
            T = rigid(Path(self.uri), "depth to colour", R, t_mm / 1000) if np.any(R) else None
        except self._binding.OBError:  # a device without
            T = None
        return CameraInfo(
            *_size(color),
            round(self._unit_mm / 1000, 9),
            self.serial,
            self._lens("color"),
            DepthGeometry(*_size(depth), self._lens("depth"), None, T),
            depth_stated=True,
        )

    def start(self) -> None:
        b, ids = self._binding, self._binding.OBPropertyID
        for automatic in (ids.OB_PROP_COLOR_AUTO_EXPOSURE_BOOL, ids.OB_PROP_COLOR_AUTO_WHITE_BALANCE_BOOL):
            with suppress(b.OBError):  # a value of an earlier session may stand
                self._handle.set_bool_property(automatic, True)
        try:
            pipeline, setup = b.Pipeline(self._handle), b.Config()
            for profile in self._profiles.values():
                setup.enable_stream(profile)
            setup.set_align_mode(b.OBAlignMode.DISABLE)
            setup.set_frame_aggregate_output_mode(
                b.OBFrameAggregateOutputMode.ANY_SITUATION
            )  # also what lacks a partner
            pipeline.start(setup)
        except b.OBError as error:
            raise CalibrationError(
                f"{self.label}: the streams do not start ({_words(error)}). Close other programs that use the camera, and give "
                "it a USB 3 controller of its own (`lsusb -t`)"
            ) from None
        self._pipeline = pipeline

    def wait_frame(self, timeout_s: float) -> SensorFrame | None:
        if not self._ready:
            frames = self._pipeline.wait_for_frames(int(1000 * timeout_s))
            if frames is None:
                return None
            arrival_s = time.monotonic()
            color, depth, infrared = frames.get_color_frame(), frames.get_depth_frame(), frames.get_ir_frame()
            rgb = None if color is None else color_of(color, self.label)
            if rgb is not None:
                self._add("color", rgb, color, arrival_s)
            if depth is not None:
                self._check_unit(depth.get_depth_scale())
                ir = None if infrared is None or "ir" not in self._profiles else values_of(infrared, self.label)
                self._add("depth", values_of(depth, self.label), depth, arrival_s, ir)
        return self._ready.popleft() if self._ready else None

    def lock_exposure(self) -> bool:
        ids = self._binding.OBPropertyID
        locked = []
        for automatic, value in (
            (ids.OB_PROP_COLOR_AUTO_EXPOSURE_BOOL, ids.OB_PROP_COLOR_EXPOSURE_INT),
            (ids.OB_PROP_COLOR_AUTO_WHITE_BALANCE_BOOL, ids.OB_PROP_COLOR_WHITE_BALANCE_INT),
        ):
            try:
                now = self._handle.get_int_property(value)
                self._handle.set_bool_property(automatic, False)
                self._handle.set_int_property(value, now)
                locked.append(not self._handle.get_bool_property(automatic))
            except self._binding.OBError:
                locked.append(False)
        return all(locked)

    def camera_settings(self) -> dict[str, Any]:
        ids = self._binding.OBPropertyID
        wanted = {
            "auto_exposure": (ids.OB_PROP_COLOR_AUTO_EXPOSURE_BOOL, self._handle.get_bool_property),
            "auto_white_balance": (ids.OB_PROP_COLOR_AUTO_WHITE_BALANCE_BOOL, self._handle.get_bool_property),
            "exposure": (ids.OB_PROP_COLOR_EXPOSURE_INT, self._handle.get_int_property),
            "gain": (ids.OB_PROP_COLOR_GAIN_INT, self._handle.get_int_property),
            "white_balance": (ids.OB_PROP_COLOR_WHITE_BALANCE_INT, self._handle.get_int_property),
            "focus": (ids.OB_PROP_COLOR_FOCUS_INT, self._handle.get_int_property),
        }
        return {name: get(one) for name, (one, get) in wanted.items() if self._has(one)}

    def set_emitter(self, on: bool) -> None:
        ids = self._binding.OBPropertyID
        try:
            if self._has(ids.OB_PROP_LASER_CONTROL_INT):
                return self._handle.set_int_property(ids.OB_PROP_LASER_CONTROL_INT, int(on))
            if self._has(ids.OB_PROP_LASER_BOOL):
                return self._handle.set_bool_property(ids.OB_PROP_LASER_BOOL, on)
        except self._binding.OBError:
            pass
        raise CalibrationError(
            f"{self.label}: its infrared projector cannot be switched. Leave out --alternate-emitters"
        )

    def close(self) -> None:
        if self._handle is None:
            return
        with suppress(self._binding.OBError):  # unplugged
            if self._pipeline is not None:
                self._pipeline.stop()
        with suppress(self._binding.OBError):  # it would wait for a pulse in later sessions too
            if self._sync_before is not None:
                self._handle.set_multi_device_sync_config(self._sync_before)
        self._pipeline = self._handle = None
        self._profiles.clear()

    def _offered(self, kind: str) -> list[Any]:
        """Modes that can be read."""
        sensors = self._binding.OBSensorType
        number = {"color": sensors.COLOR_SENSOR, "depth": sensors.DEPTH_SENSOR, "ir": sensors.IR_SENSOR}[kind]
        try:
            profiles = self._handle.get_sensor(number).get_stream_profile_list()
        except self._binding.OBError:  # no such sensor
            return []
        videos = [
            profiles.get_stream_profile_by_index(i).as_video_stream_profile() for i in range(profiles.get_count())
        ]
        return [video for video in videos if video.get_format().name in FORMATS[kind]]

    def _stays_mirrored(self) -> bool:
        ids = self._binding.OBPropertyID
        mirrored = []
        for one in (ids.OB_PROP_COLOR_MIRROR_BOOL, ids.OB_PROP_DEPTH_MIRROR_BOOL, ids.OB_PROP_IR_MIRROR_BOOL):
            if self._has(one):
                with suppress(self._binding.OBError):
                    self._handle.set_bool_property(one, False)
                mirrored.append(self._handle.get_bool_property(one))
        return any(mirrored)

    def _has(self, one: Any) -> bool:
        return bool(self._handle.is_property_supported(one, self._binding.OBPermissionType.PERMISSION_READ))

    def _lens(self, kind: str) -> Intrinsics:
        own, d = self._profiles[kind].get_intrinsic(), self._profiles[kind].get_distortion()
        model = d.model.name
        k = (d.k1, d.k2, d.k3, d.k4) if "KANNALA" in model else (d.k1, d.k2, d.p1, d.p2, d.k3, d.k4, d.k5, d.k6)
        size = (own.width, own.height)
        return lens_of_maker(Path(self.uri), kind, size, (own.fx, own.fy), (own.cx, own.cy), model, k)[0]

    def _add(self, kind: Kind, pixels: np.ndarray, frame: Any, arrival_s: float, ir: np.ndarray | None = None) -> None:
        stamp_us, index = int(frame.get_timestamp_us()), int(frame.get_index())
        self._ready.append(SensorFrame(kind, pixels, stamp_us, index, arrival_s, ir))

    def _check_unit(self, unit_mm: float) -> None:
        if self._unit_mm is not None and unit_mm != self._unit_mm:
            raise CalibrationError(
                f"{self.label}: the unit of depth changed from {self._unit_mm:g} to {unit_mm:g} mm. Leave the camera's "
                "settings alone while it records"
            )
        self._unit_mm = unit_mm


def _preference(kind: str, profile: Any) -> tuple[bool, bool, int, int]:
    width, height = _size(profile)
    fits = kind != "color" or width * height <= MOST_COLOR_PX
    usual = (width, height) == (WIDTH, HEIGHT)
    return usual, fits, width * height if fits else -width * height, -FORMATS[kind].index(profile.get_format().name)


def _size(profile: Any) -> tuple[int, int]:
    return int(profile.get_width()), int(profile.get_height())


def _mode(kind: str, profile: Any) -> str:
    width, height = _size(profile)
    return f"{kind} {width}x{height}@{profile.get_fps()} {profile.get_format().name}"


def _words(error: Exception) -> str:
    return " ".join(str(error).split())


@contextmanager
def _silent() -> Iterator[None]:
    """The binding prints where it looks for its extensions when it is imported; stdout is for results."""
    sys.stdout.flush()
    kept, nothing = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nothing)

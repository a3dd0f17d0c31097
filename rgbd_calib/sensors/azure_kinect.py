"""Azure Kinect cameras by Microsoft's SDK (`pip install 'rgbd-calib[azure]'`), on Linux.

Depth (NFOV unbinned, 640x576) is taken as the device measures it, in its own geometry, with its infrared image and the
factory's lenses and extrinsics; colour is 1280x720. The device is found by the serial number of its colour camera on the
USB, as the SDK finds it: an attached device is opened only when it is asked for.
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.calibrations.azure_ import read_device
from rgbd_calib.io.dataset import CameraInfo, DepthGeometry
from rgbd_calib.sensors import k4a
from rgbd_calib.sensors.driver import Device, DeviceSettings, OpenedDevices, field_of_view_rad, kinds_of
from rgbd_calib.sensors.frames import Kind, SensorFrame
from rgbd_calib.sensors.usb import UsbDevice, usb_devices, usb_place

COLOR_SIZE, DEPTH_SIZE = (1280, 720), (640, 576)
"""Of RES_720P and NFOV_UNBINNED."""
UDEV = """SUBSYSTEM=="usb", ATTR{idVendor}=="045e", ATTR{idProduct}=="097?", MODE="0666\""""
_PREFIX = "azure:"
_USB = ("045e", "097d")
_LASER_SLOT_US = 160
"""Between the lasers of two cameras on one cable: closer ones disturb each other (Azure Kinect: synchronise multiple devices)."""
_WHITE_BALANCE_STEP_K = 10
_MODES = [f"color {COLOR_SIZE[0]}x{COLOR_SIZE[1]}@30 BGRA32", f"depth {DEPTH_SIZE[0]}x{DEPTH_SIZE[1]}@30 NFOV_UNBINNED"]


def load_azure() -> AzureKinects:
    """The driver.

    Raises
    ------
    ConfigError
        The SDK is not installed.
    """
    try:
        return AzureKinects(k4a.load_library(), lambda: usb_devices(*_USB))
    except (OSError, AttributeError) as error:
        raise ConfigError(
            f"Azure Kinect cameras: the Azure Kinect SDK ({k4a.SYSTEM_LIBRARY}) does not load ({error}). "
            "`pip install 'rgbd-calib[azure]'` (Linux on x86_64, Python up to 3.12), or Microsoft's package libk4a1.4"
        ) from None


class AzureKinects(OpenedDevices):
    """The driver.

    Parameters
    ----------
    attached
        Gives the colour cameras that are attached now.
    """

    prefix = _PREFIX

    def __init__(self, library: k4a.K4a, attached: Callable[[], Sequence[UsbDevice]]) -> None:
        self._library, self._attached = library, attached
        super().__init__()

    @property
    def label(self) -> str:
        return "Azure Kinect SDK 1.4"

    def uris(self) -> list[str]:
        return [f"{_PREFIX}{device.serial}@{device.address}" for device in self._attached()]

    def permission(self, uri: str) -> str:
        return (
            f"Write `{UDEV}` to /etc/udev/rules.d/99-k4a.rules, then "
            "`sudo udevadm control --reload && sudo udevadm trigger`"
        )

    def open(self, uri: str) -> Device:
        wanted = uri.removeprefix(_PREFIX).partition("@")[0]
        reason = "no longer attached"
        for index in range(self._library.count()):
            try:
                handle = self._library.open(index)
            except k4a.K4aError as error:  # in use, by this program or another
                reason = str(error)
                continue
            try:
                if self._library.serial(handle) == wanted:
                    device = AzureKinect(self._library, handle, uri, wanted)
                    self._opened.append(device)
                    return device
            except k4a.K4aError as error:
                reason = str(error)
            self._library.close(handle)
        raise CalibrationError(
            f"{uri}: the device does not open ({reason}). Close other programs that use it, and replug it at a USB 3 port. "
            f"If permission is denied: {self.permission(uri)}"
        )


class AzureKinect:
    """One camera; without depth the laser stays off, and no OpenGL is needed."""

    vendor, name = "Microsoft", "Azure Kinect"

    def __init__(self, library: k4a.K4a, handle: Any, uri: str, serial: str) -> None:
        self._library, self._handle, self.uri = library, handle, uri
        self.serial: str | None = serial
        self.firmware: str | None = library.firmware(handle)
        self._place = usb_place(uri)
        self._setup = k4a.Configuration(
            k4a.BGRA32, k4a.RES_720P, k4a.NFOV_UNBINNED, k4a.FPS_30, False, 0, k4a.STANDALONE, 0, False
        )
        self._ready: deque[SensorFrame] = deque()
        self._counts: dict[Kind, int] = {"color": 0, "depth": 0}
        self._color: k4a.Image | None = None
        self._running = self._locked = False

    @property
    def usb_path(self) -> str:
        return self._place.path if self._place else self.uri

    @property
    def label(self) -> str:
        return f"{self.uri} ({self.name})"

    @property
    def sizes(self) -> dict[Kind, tuple[int, int]]:
        sizes: dict[Kind, tuple[int, int]] = {"color": COLOR_SIZE, "depth": DEPTH_SIZE}
        return {kind: sizes[kind] for kind in kinds_of(self._setup.depth_mode == k4a.DEPTH_OFF)}

    def modes(self) -> list[str]:
        return list(_MODES)

    def configure(self, allow_unregistered: bool = False, color_only: bool = False) -> DeviceSettings:
        """1280x720 and 640x576 at 30 fps.

        Raises
        ------
        CalibrationError
            The device does not give its calibration.
        """
        try:
            tree = json.loads(self._library.calibration(self._handle))
            found = read_device(Path(self.uri), tree, COLOR_SIZE, DEPTH_SIZE)
        except (k4a.K4aError, ValueError, ConfigError) as error:
            raise CalibrationError(
                f"{self.label}: no calibration of the factory ({error}). Replug the device"
            ) from None
        assert found.intrinsics is not None and found.depth is not None  # both sizes were asked for
        self._lens: Intrinsics = found.intrinsics
        own = found.depth
        self._geometry = DepthGeometry(*DEPTH_SIZE, own.intrinsics, None, own.T_color_depth)
        fov = field_of_view_rad(COLOR_SIZE, self._lens.vector[:2].tolist())
        color, depth = (mode.split(" ", 1)[1] for mode in _MODES)
        if color_only:
            self._setup.depth_mode = k4a.DEPTH_OFF
        return DeviceSettings.of(self, color, None if color_only else depth, fov, place=self._place)

    def set_sync(self, place: int) -> bool:
        inward, outward = self._library.sync_jacks(self._handle)
        if not (outward if place == 0 else inward):
            return False
        self._setup.wired_sync_mode = k4a.MASTER if place == 0 else k4a.SUBORDINATE
        self._setup.subordinate_delay_off_master_usec = place * _LASER_SLOT_US
        return True

    def describe(self) -> CameraInfo:
        if self._setup.depth_mode == k4a.DEPTH_OFF:
            return CameraInfo(*COLOR_SIZE, serial=self.serial, intrinsics=self._lens)
        return CameraInfo(*COLOR_SIZE, 0.001, self.serial, self._lens, self._geometry, depth_stated=True)

    def start(self) -> None:
        try:
            for command in (k4a.EXPOSURE, k4a.WHITE_BALANCE):  # a value of an earlier session may stand
                self._library.set_color_control(self._handle, command, None)
            self._library.start(self._handle, self._setup)
        except k4a.K4aError as error:
            raise CalibrationError(
                f"{self.label}: the streams do not start ({error}). Close other programs that use the camera and give it a "
                "USB 3 controller of its own (`lsusb -t`). Its depth needs OpenGL 4.4 and a display (DISPLAY is set)"
            ) from None
        self._running = True

    def wait_frame(self, timeout_s: float) -> SensorFrame | None:
        if not self._ready:
            try:
                capture = self._library.capture(self._handle, int(1000 * timeout_s))
            except k4a.K4aError as error:
                raise CalibrationError(f"{self.label}: no more frames ({error}). Is it unplugged?") from None
            if capture is None:
                return None
            arrival_s = time.monotonic()
            if capture.color is not None:
                self._color = capture.color
                rgb = np.ascontiguousarray(capture.color.pixels[..., 2::-1])
                self._ready.append(self._frame("color", rgb, capture.color, arrival_s))
            if capture.depth is not None:
                infrared = None if capture.infrared is None else capture.infrared.pixels
                self._ready.append(self._frame("depth", capture.depth.pixels, capture.depth, arrival_s, infrared))
        return self._ready.popleft() if self._ready else None

    def lock_exposure(self) -> bool:
        """The focus is fixed. While exposure is automatic, only the images say what it is."""
        if self._color is None:
            return False
        balance_K = round(self._color.white_balance_K / _WHITE_BALANCE_STEP_K) * _WHITE_BALANCE_STEP_K
        self._locked = True
        try:
            self._library.set_color_control(self._handle, k4a.EXPOSURE, self._color.exposure_us)
            self._library.set_color_control(self._handle, k4a.WHITE_BALANCE, balance_K)
            return not any(self._library.color_control(self._handle, c)[0] for c in (k4a.EXPOSURE, k4a.WHITE_BALANCE))
        except k4a.K4aError:
            return False

    def camera_settings(self) -> dict[str, Any]:
        auto_exposure, exposure_us = self._library.color_control(self._handle, k4a.EXPOSURE)
        auto_balance, balance_K = self._library.color_control(self._handle, k4a.WHITE_BALANCE)
        found: dict[str, Any] = {"auto_exposure": auto_exposure, "auto_white_balance": auto_balance, "focus": "fixed"}
        if not auto_exposure:
            found["exposure"] = exposure_us
        if not auto_balance:
            found["white_balance"] = balance_K
        return found

    def set_emitter(self, on: bool) -> None:
        raise CalibrationError(
            f"{self.label}: its infrared laser cannot be switched. Leave out --alternate-emitters; --sync lets the lasers of "
            "several cameras take turns"
        )

    def close(self) -> None:
        if self._handle is None:
            return
        if self._locked:
            with suppress(k4a.K4aError):  # unplugged; else the device would keep it until it loses power
                for command in (k4a.EXPOSURE, k4a.WHITE_BALANCE):
                    self._library.set_color_control(self._handle, command, None)
        if self._running:
            self._library.stop(self._handle)
        self._library.close(self._handle)
        self._handle = None

    def _frame(
        self, kind: Kind, pixels: np.ndarray, image: k4a.Image, arrival_s: float, infrared: np.ndarray | None = None
    ) -> SensorFrame:
        self._counts[kind] += 1
        return SensorFrame(kind, pixels, image.device_us, self._counts[kind] - 1, arrival_s, infrared)

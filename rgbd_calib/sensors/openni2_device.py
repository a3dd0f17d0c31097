"""One OpenNI2 device behind a few methods; only this module and `openni2` see the binding.

Its traps, kept from everybody else: names are bytes; the serial number has no helper; registration can be set only
after a depth stream exists; `read_frame` on a silent stream never returns, so a frame is always waited for first; a
device that is closed before its streams crashes the process; once a thread has ended that called the runtime, the next new
one that calls crashes it too (see `lasting_threads`).
"""

from __future__ import annotations

import ctypes
import time
from typing import Any

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.io.dataset import CameraInfo, DepthGeometry
from rgbd_calib.sensors.driver import DeviceSettings
from rgbd_calib.sensors.frames import Kind, SensorFrame
from rgbd_calib.sensors.usb import UsbPlace, usb_place

WIDTH, HEIGHT, FPS = 640, 480, 30
EMITTER_STATE = 0x1080E007
"""XN_MODULE_PROPERTY_EMITTER_STATE of PS1080.h: the infrared projector."""

_SERIAL, _FIRMWARE = 3, 0
_EXPOSURE_S = (
    0.5  # after the start a camera does not take settings of exposure at once (ros-drivers/openni2_camera issue 51)
)
_CLOSE_PAUSE_S = 0.05  # between stopping and closing streams: the runtime's threads need it


class OpenNi2Device:
    """An open device with one colour and one depth stream, or colour alone."""

    def __init__(self, binding: Any, handle: Any) -> None:
        self._binding = binding
        self._handle = handle
        self._color: Any = None
        self._depth: Any = None
        self._running = False
        self._registered = True
        self.uri: str = handle.uri.decode()
        self.name: str = handle.device_info.name.decode()
        self.vendor: str = handle.device_info.vendor.decode()
        self.serial = self._text_property(_SERIAL)
        self.firmware = self._text_property(_FIRMWARE)
        self.place: UsbPlace | None = usb_place(self.uri)

    @property
    def is_file(self) -> bool:
        return bool(self._handle.is_file())

    @property
    def usb_path(self) -> str:
        """The port it hangs on; its uri where the port is not known."""
        return self.place.path if self.place else self.uri

    @property
    def sizes(self) -> dict[Kind, tuple[int, int]]:
        return {kind: (WIDTH, HEIGHT) for kind in self._streams()}

    def modes(self) -> list[str]:
        """Video modes of both streams, such as `color 640x480@30 RGB888`."""
        found = []
        for kind, sensor in (("color", self._binding.SENSOR_COLOR), ("depth", self._binding.SENSOR_DEPTH)):
            info = self._handle.get_sensor_info(sensor)
            found += [f"{kind} {_mode_text(mode)}" for mode in (info.videoModes if info else [])]
        return found

    def create_streams(self, color_only: bool = False) -> None:
        """Make both streams, the depth one first: registration needs it. A device without a depth sensor has one.

        Raises
        ------
        CalibrationError
            The device has no colour sensor, or refuses.
        """
        self._depth = None if color_only else self._stream("depth")
        self._color = self._stream("color")
        if self._color is None:
            raise CalibrationError(f"{self.label}: it has no colour sensor; a calibration needs it. Leave it out")

    def configure(self, allow_unregistered: bool = False, color_only: bool = False) -> DeviceSettings:
        """VGA at 30 fps, depth registered to colour, mirroring off; set, read back and checked.

        Raises
        ------
        CalibrationError
            The device refuses one of them, or says that it took it and did not.
        """
        b = self._binding
        self.create_streams(color_only)
        if self._depth is not None:
            self._set(
                "video mode",
                lambda: self._depth.configure_mode(WIDTH, HEIGHT, FPS, b.PIXEL_FORMAT_DEPTH_1_MM),
                f"depth {WIDTH}x{HEIGHT} at {FPS} fps in millimetres",
            )
        self._set(
            "video mode",
            lambda: self._color.configure_mode(WIDTH, HEIGHT, FPS, b.PIXEL_FORMAT_RGB888),
            f"RGB888 colour {WIDTH}x{HEIGHT} at {FPS} fps",
        )
        for stream in self._streams().values():
            self._set("mirroring", lambda s=stream: s.set_mirroring_enabled(False), "pictures that are not mirrored")
        self._registered = self._depth is not None and self._register(allow_unregistered)
        settings = self.settings(self._registered)
        if settings.mirrored:
            raise CalibrationError(
                f"{self.label}: pictures stay mirrored after mirroring was switched off; a calibration needs them as seen. "
                "Replug the device, or update its firmware"
            )
        for kind, stream in self._streams().items():
            mode = stream.video_mode
            if (mode.resolutionX, mode.resolutionY, mode.fps) != (WIDTH, HEIGHT, FPS):
                raise CalibrationError(
                    f"{self.label}: the {kind} stream stays at {_mode_text(mode)}, {WIDTH}x{HEIGHT}@{FPS} needed. "
                    "Replug the device"
                )
        return settings

    def set_sync(self, place: int) -> bool:
        return False

    def describe(self) -> CameraInfo:
        """Sizes and the unit of depth; it states no lens."""
        if self._depth is None:
            return CameraInfo(WIDTH, HEIGHT, serial=self.serial)
        own = None if self._registered else DepthGeometry(WIDTH, HEIGHT)
        return CameraInfo(WIDTH, HEIGHT, self.depth_unit_m(), self.serial, depth=own, depth_stated=True)

    def settings(self, registered: bool) -> DeviceSettings:
        """What the device and its streams say now."""
        return DeviceSettings.of(
            self,
            _mode_text(self._color.video_mode),
            None if self._depth is None else _mode_text(self._depth.video_mode),
            (float(self._color.get_horizontal_fov()), float(self._color.get_vertical_fov())),
            place=self.place,
            registered=registered,
            mirrored=any(stream.mirroring_enabled for stream in self._streams().values()),
        )

    @property
    def label(self) -> str:
        """How messages name it."""
        return f"{self.uri} (serial {self.serial or 'unknown'})"

    def start(self) -> None:
        """Start the streams, exposure and white balance automatic.

        Raises
        ------
        CalibrationError
            The runtime refuses.
        """
        for kind, stream in self._streams().items():
            try:
                stream.start()
            except self._binding.OpenNIError as error:
                raise CalibrationError(
                    f"{self.label}: the {kind} stream does not start ({reason(error)}). Give the "
                    "camera a USB 2.0 controller of its own (`lsusb -t`), and replug it"
                ) from None
        self._running = True
        until_s = time.monotonic() + _EXPOSURE_S
        while not self._set_automatic(True) and time.monotonic() < until_s:
            time.sleep(_EXPOSURE_S / 10)

    def wait_frame(self, timeout_s: float) -> SensorFrame | None:
        """The next frame of either stream, copied; None where none comes in time. Call it from one thread only."""
        stream = self._binding.wait_for_any_stream(list(self._streams().values()), timeout_s)
        if stream is None:
            return None
        frame = stream.read_frame()
        try:
            arrival_s = time.monotonic()
            kind: Kind = "color" if stream is self._color else "depth"
            pixels = _copy(frame, 3 if kind == "color" else 1)
            return SensorFrame(kind, pixels, int(frame.timestamp), int(frame.frameIndex), arrival_s)
        finally:
            frame.close()

    def lock_exposure(self) -> bool:
        """Freeze exposure and white balance as they are now; False where the camera does not take it."""
        return self._color.camera is not None and self._set_automatic(False)

    def camera_settings(self) -> dict[str, Any]:
        """Exposure and white balance as the camera reports them."""
        camera = self._color.camera
        if camera is None:
            return {}
        return {
            "auto_exposure": camera.auto_exposure,
            "auto_white_balance": camera.auto_white_balance,
            "exposure": camera.exposure,
            "gain": camera.gain,
        }

    def set_emitter(self, on: bool) -> None:
        """Switch the infrared projector.

        Raises
        ------
        CalibrationError
            The device has no such switch.
        """
        try:
            self._handle.set_property(EMITTER_STATE, int(on))
        except self._binding.OpenNIError as error:
            raise CalibrationError(
                f"{self.label}: its infrared projector cannot be switched ({reason(error)}); --alternate-emitters needs that. "
                "Record without it"
            ) from None

    def play_as_fast_as_read(self) -> None:
        """Of a recorded file: each read brings the next frame, nothing is dropped, and the end is the end."""
        self._handle.playback.repeat = False
        self._handle.playback.speed = -1.0

    def frame_count(self) -> dict[Kind, int]:
        """Frames in a recorded file, by stream."""
        return {kind: stream.get_number_of_frames() for kind, stream in self._streams().items()}

    def is_mirrored(self) -> bool:
        """Of a recorded file: True where it says that its pictures are mirrored."""
        try:
            return bool(self._color.mirroring_enabled)
        except self._binding.OpenNIError:
            return False

    def depth_unit_m(self) -> float:
        """Metres for each unit of the depth stream, if there is one."""
        if self._depth is None:
            return 1e-3
        tenths = int(self._depth.video_mode.pixelFormat) == int(self._binding.PIXEL_FORMAT_DEPTH_100_UM)
        return 1e-4 if tenths else 1e-3

    def close(self) -> None:
        """Stop and close, streams before the device. No thread may be reading; calling it twice does nothing."""
        if not self._handle:
            return
        streams = self._streams().values()
        if self._running:
            for stream in streams:
                stream.stop()
            self._running = False
            time.sleep(_CLOSE_PAUSE_S)
        for stream in streams:
            stream.close()
        self._handle.close()

    def _stream(self, kind: str) -> Any:
        """None where the device has no such sensor."""
        b = self._binding
        try:
            made = self._handle.create_depth_stream() if kind == "depth" else self._handle.create_color_stream()
        except b.OpenNIError as error:
            raise CalibrationError(f"{self.label}: no {kind} stream ({reason(error)}). Replug the device") from None
        return made

    def _streams(self) -> dict[Kind, Any]:
        """Those that it has, depth first."""
        made: dict[Kind, Any] = {"depth": self._depth, "color": self._color}
        return {kind: stream for kind, stream in made.items() if stream is not None}

    def _register(self, allow_unregistered: bool) -> bool:
        wanted = self._binding.IMAGE_REGISTRATION_DEPTH_TO_COLOR
        seen = "it does not offer registration"
        if self._handle.is_image_registration_mode_supported(wanted):
            try:
                self._handle.set_image_registration_mode(wanted)
                if int(self._handle.get_image_registration_mode()) == int(wanted):
                    return True
                seen = "it stays off after it was switched on"
            except self._binding.OpenNIError as error:
                seen = reason(error)
        if allow_unregistered:
            return False
        raise CalibrationError(
            f"{self.label}: depth is not registered to colour ({seen}); a calibration needs it registered. "
            "Replug or replace the camera, or record its colour alone with --color-only"
        )

    def _set(self, what: str, call: Any, needed: str) -> None:
        try:
            call()
        except self._binding.OpenNIError as error:
            raise CalibrationError(
                f"{self.label}: {what} refused ({reason(error)}); needed: {needed}. "
                "`rgbd-calib devices` lists what the camera offers"
            ) from None

    def _set_automatic(self, on: bool) -> bool:
        """Exposure and white balance; True where the camera took it, or has neither."""
        camera = self._color.camera
        if camera is None:
            return True
        try:
            camera.auto_exposure = camera.auto_white_balance = on
            return bool(camera.auto_exposure) == bool(camera.auto_white_balance) == on
        except self._binding.OpenNIError:
            return False

    def _text_property(self, number: int) -> str | None:
        try:
            text: bytes = self._handle.get_property(number, ctypes.c_char * 256).value
        except self._binding.OpenNIError:
            return None
        return text.decode(errors="replace").strip() or None


def reason(error: Exception) -> str:
    """What the runtime said, as one line of text."""
    parts = [p.decode(errors="replace") if isinstance(p, bytes) else p for p in error.args]
    text = next((p for p in parts[1:] if isinstance(p, str) and p.strip()), None) or str(parts[0])
    return " ".join(text.split())


def _copy(frame: Any, channels: int) -> np.ndarray:
    """The pixels of a frame, copied: the runtime reuses its memory."""
    size = (frame.height, frame.width, 3) if channels == 3 else (frame.height, frame.width)
    dtype = np.uint8 if channels == 3 else np.uint16
    rows = np.frombuffer(frame.get_buffer_as_uint8(), np.uint8, frame.stride * frame.height)
    rows = rows.reshape(frame.height, frame.stride)[:, : frame.width * channels * np.dtype(dtype).itemsize]
    return np.array(rows).view(dtype).reshape(size)


def _mode_text(mode: Any) -> str:
    from openni import _openni2

    number = mode.pixelFormat.value
    name = _openni2.OniPixelFormat._values_.get(number, str(number)).removeprefix("ONI_PIXEL_FORMAT_")
    return f"{mode.resolutionX}x{mode.resolutionY}@{mode.fps} {name}"

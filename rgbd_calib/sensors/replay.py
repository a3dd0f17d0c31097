"""A recording played as cameras, over and over, at 30 frames a second: for trying the program, and for tests."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.io.dataset import CameraInfo
from rgbd_calib.io.depth_files import read_depth_raw
from rgbd_calib.io.recording import Recording, open_recording
from rgbd_calib.sensors.driver import Device, DeviceSettings, field_of_view_rad
from rgbd_calib.sensors.frames import PERIOD_S, Kind, SensorFrame

_PREFIX = "replay:"
FPS = round(1 / PERIOD_S)


class Replay:
    """The cameras of a recording; each plays the frames that all cameras have: in colour, and in depth where they have any."""

    def __init__(self, path: Path) -> None:
        self._recording = open_recording(path)
        self._start_s = time.monotonic()
        self._devices: list[ReplayedCamera] = []

    @property
    def label(self) -> str:
        return f"replay of {self._recording.path}"

    def uris(self) -> list[str]:
        return [f"{_PREFIX}{camera}" for camera in self._recording.cameras]

    def permission(self, uri: str) -> str:
        return "Make the recording readable"

    def owns(self, uri: str) -> bool:
        return uri.startswith(_PREFIX)

    def open(self, uri: str) -> Device:
        device = ReplayedCamera(self._recording, uri.removeprefix(_PREFIX), self._start_s)
        self._devices.append(device)
        return device

    def abandon(self) -> None:
        pass

    def close(self) -> None:
        for device in self._devices:
            device.close()
        self._devices.clear()


class ReplayedCamera:
    """One camera of a recording. All cameras show the same frame at the same time."""

    vendor = "rgbd-calib"
    firmware: str | None = None

    def __init__(self, recording: Recording, camera: str, start_s: float) -> None:
        info = recording.cameras[camera]
        self._recording, self._camera, self._info, self._start_s = recording, camera, info, start_s
        self._has_depth = bool(recording.depth_files[camera])
        self.uri, self.name = f"{_PREFIX}{camera}", f"replay of {camera}"
        self.serial: str | None = info.serial or camera
        self._choose_frames()
        self._next = 0  # frame k is 2k (colour) and 2k + 1 (depth)
        self._open = True

    @property
    def usb_path(self) -> str:
        return self.uri

    @property
    def label(self) -> str:
        return f"{self.uri} (serial {self.serial})"

    @property
    def sizes(self) -> dict[Kind, tuple[int, int]]:
        sizes: dict[Kind, tuple[int, int]] = {"color": (self._info.width, self._info.height)}
        return sizes | ({"depth": self._info.depth_size} if self._has_depth else {})

    def modes(self) -> list[str]:
        forms = {"color": "RGB888", "depth": "Z16"}
        return [f"{kind} {width}x{height}@{FPS} {forms[kind]}" for kind, (width, height) in self.sizes.items()]

    def configure(self, allow_unregistered: bool = False, color_only: bool = False) -> DeviceSettings:
        if color_only:
            self._has_depth = False
            self._choose_frames()
        color, depth = (mode.split(" ", 1)[1] for mode in (*self.modes(), " ")[:2])
        lens = self._info.intrinsics
        size = (self._info.width, self._info.height)
        fov = field_of_view_rad(size, (0.0, 0.0) if lens is None else lens.vector[:2].tolist())
        return DeviceSettings.of(
            self, color, depth or None, fov, registered=self._has_depth and self._info.depth is None
        )

    def _choose_frames(self) -> None:
        """Those that all cameras have."""
        own = self._recording
        with_depth = own.cameras_with_depth if self._has_depth else []
        self._frames = [
            f
            for f in own.frames
            if all(f in own.color_files[c] for c in own.cameras) and all(own.has_depth(c, f) for c in with_depth)
        ]
        if not self._frames:
            raise CalibrationError(
                f"{own.path}: {self._camera}: a frame needed that all cameras have, none found. Play another recording"
            )

    def set_sync(self, place: int) -> bool:
        return False

    def describe(self) -> CameraInfo:
        own = self._info
        return (
            own if self._has_depth else CameraInfo(own.width, own.height, serial=own.serial, intrinsics=own.intrinsics)
        )

    def start(self) -> None:
        self._next = 2 * (int((time.monotonic() - self._start_s) / PERIOD_S) + 1)

    def wait_frame(self, timeout_s: float) -> SensorFrame | None:
        index, is_depth = divmod(self._next, 2)
        wait_s = self._start_s + index * PERIOD_S - time.monotonic()
        if wait_s > timeout_s or not self._open:
            time.sleep(timeout_s)
            return None
        time.sleep(max(wait_s, 0.0))
        late = int(-wait_s / PERIOD_S)
        if late > 1 and not is_depth:  # the computer is too slow: frames are lost, as a camera loses them
            self._next += 2 * late
            index += late
        self._next += 1 if self._has_depth else 2
        frame = self._frames[index % len(self._frames)]
        if is_depth:
            path = self._recording.depth_files[self._camera][frame]
            pixels = read_depth_raw(path, self._info.depth_size, "dataset.yaml has")
        else:
            pixels = np.ascontiguousarray(self._recording.color(self._camera, frame)[..., ::-1])
        return SensorFrame(
            "depth" if is_depth else "color", pixels, round(index * PERIOD_S * 1e6), index, time.monotonic()
        )

    def lock_exposure(self) -> bool:
        return True

    def camera_settings(self) -> dict[str, Any]:
        return {}

    def set_emitter(self, on: bool) -> None:
        raise CalibrationError(
            f"{self.label}: its infrared projector cannot be switched. Leave out --alternate-emitters"
        )

    def close(self) -> None:
        self._open = False

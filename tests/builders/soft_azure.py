"""Azure Kinect cameras without hardware: a double of `rgbd_calib.sensors.k4a.K4a`."""

from __future__ import annotations

import json
import queue
from typing import ClassVar

import numpy as np
from soft_cameras import LENS, T_COLOR_DEPTH, SoftCamera

from rgbd_calib.sensors import k4a
from rgbd_calib.sensors.azure_kinect import AzureKinects
from rgbd_calib.sensors.usb import UsbDevice


class SoftAzure(SoftCamera):
    """`cable`: one is plugged in both of its jacks."""

    sizes: ClassVar = {"color": (1280, 720), "depth": (640, 576)}
    unit_m = 0.001
    prefix = "azure:"
    may_lack_depth = False

    def __init__(self, serial: str, cable: bool = False) -> None:
        super().__init__(serial)
        self.cable = cable
        self.waiting: queue.SimpleQueue[k4a.Capture] = queue.SimpleQueue()
        self.controls: dict[int, int | None] = {k4a.EXPOSURE: 2500, k4a.WHITE_BALANCE: 4500}
        self.setup: k4a.Configuration | None = None
        self.is_open = False

    @property
    def automatic(self) -> tuple[bool, bool]:
        return self.controls[k4a.EXPOSURE] is None, self.controls[k4a.WHITE_BALANCE] is None

    @property
    def sync_place(self) -> int | None:
        assert self.setup is not None
        return {k4a.STANDALONE: None, k4a.MASTER: 0, k4a.SUBORDINATE: 1}[self.setup.wired_sync_mode]

    def deliver(self, frames: dict, device_us: int, number: int) -> None:
        if self.setup is None:
            return
        color, depth = frames.get("color"), frames.get("depth")
        if self.setup.depth_mode == k4a.DEPTH_OFF:
            depth = None
        bgra = None if color is None else np.dstack([color[..., ::-1], np.full_like(color[..., 0], 255)])
        self.waiting.put(
            k4a.Capture(
                None if bgra is None else k4a.Image(bgra, device_us, 8330, 4504),
                None if depth is None else k4a.Image(depth, device_us, 0, 0),
                None if depth is None else k4a.Image(depth // 8, device_us, 0, 0),
            )
        )

    def calibration(self) -> str:
        """The lens of LENS in both streams, in units of the sensor's image as the device states it."""
        fx, fy, cx, cy, k1, k2, p1, p2 = LENS

        def camera(location: str, sensor, crop, pose: np.ndarray) -> dict:
            width, height = sensor
            values = [(cx + crop[0] + 0.5) / width, (cy + crop[1] + 0.5) / height, fx / width, fy / height]
            return {
                "Location": f"CALIBRATION_CameraLocation{location}",
                "SensorWidth": 4096 if location == "PV0" else 1024,
                "SensorHeight": 3072 if location == "PV0" else 1024,
                "Intrinsics": {
                    "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
                    "ModelParameters": [*values, k1, k2, 0, 0, 0, 0, 0, 0, p2, p1],
                },
                "Rt": {"Rotation": pose[:3, :3].ravel().tolist(), "Translation": pose[:3, 3].tolist()},
            }

        cameras = [
            camera("D0", (1024, 1024), (192, 180), np.eye(4)),
            camera("PV0", (1280, 960), (0, 120), T_COLOR_DEPTH),
        ]
        return json.dumps({"CalibrationInformation": {"Cameras": cameras}})

    @staticmethod
    def driver(attached: list[SoftAzure]) -> AzureKinects:
        return AzureKinects(
            SoftK4a(attached), lambda: [UsbDevice(camera.serial, f"9{i}/1") for i, camera in enumerate(attached)]
        )


class SoftK4a:
    """Methods as those of K4a; a handle is the camera itself."""

    def __init__(self, attached: list[SoftAzure]) -> None:
        self.attached = attached

    def count(self) -> int:
        return len(self.attached)

    def open(self, index: int) -> SoftAzure:
        if self.attached[index].is_open:
            raise k4a.K4aError("libusb device(s) are all unavalable")
        self.attached[index].is_open = True
        return self.attached[index]

    def close(self, device: SoftAzure) -> None:
        device.is_open = False

    def serial(self, device: SoftAzure) -> str:
        return device.serial

    def firmware(self, device: SoftAzure) -> str:
        return "1.6.110"

    def calibration(self, device: SoftAzure) -> str:
        return device.calibration()

    def sync_jacks(self, device: SoftAzure) -> tuple[bool, bool]:
        return device.cable, device.cable

    def color_control(self, device: SoftAzure, command: int) -> tuple[bool, int]:
        value = device.controls[command]
        return value is None, value or 0

    def set_color_control(self, device: SoftAzure, command: int, value: int | None) -> None:
        if command == k4a.WHITE_BALANCE and value is not None and value % 10:
            raise k4a.K4aError("white balance in steps of 10 K")
        device.controls[command] = value

    def start(self, device: SoftAzure, configuration: k4a.Configuration) -> None:
        device.setup = configuration

    def stop(self, device: SoftAzure) -> None:
        device.setup = None

    def capture(self, device: SoftAzure, timeout_ms: int) -> k4a.Capture | None:
        try:
            return device.waiting.get(timeout=timeout_ms / 1000)
        except queue.Empty:
            if device not in self.attached:
                raise k4a.K4aError("capturesync_get_capture() failed") from None
            return None

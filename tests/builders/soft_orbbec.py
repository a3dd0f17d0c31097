"""Orbbec cameras without hardware: a double of the package pyorbbecsdk, with what the driver uses of it.

tests/sensors/test_orbbec.py holds its names against those of the package, where that is installed.
"""

from __future__ import annotations

import queue
from enum import IntEnum
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
from soft_cameras import LENS, T_COLOR_DEPTH, SoftCamera

from rgbd_calib.sensors.orbbec import OrbbecCameras


class OBError(Exception):
    pass


OBFormat = IntEnum("OBFormat", {"RGB": 22, "BGR": 23, "MJPG": 5, "YUYV": 0, "Y16": 8, "Y8": 9, "Z16": 28})
OBSensorType = IntEnum("OBSensorType", {"IR_SENSOR": 1, "COLOR_SENSOR": 2, "DEPTH_SENSOR": 3})
OBAlignMode = IntEnum("OBAlignMode", {"DISABLE": 0})
OBFrameAggregateOutputMode = IntEnum("OBFrameAggregateOutputMode", {"ANY_SITUATION": 2})
OBLogLevel = IntEnum("OBLogLevel", {"NONE": 5})
OBPermissionType = IntEnum("OBPermissionType", {"PERMISSION_READ": 1})
OBCameraDistortionModel = IntEnum("OBCameraDistortionModel", {"BROWN_CONRADY_K6": 4})
OBMultiDeviceSyncMode = IntEnum(
    "OBMultiDeviceSyncMode", {"FREE_RUN": 1, "PRIMARY": 4, "SECONDARY": 8, "SECONDARY_SYNCED": 16}
)
OBPropertyID = IntEnum(
    "OBPropertyID",
    [
        "OB_PROP_COLOR_AUTO_EXPOSURE_BOOL",
        "OB_PROP_COLOR_AUTO_WHITE_BALANCE_BOOL",
        "OB_PROP_COLOR_EXPOSURE_INT",
        "OB_PROP_COLOR_FOCUS_INT",
        "OB_PROP_COLOR_GAIN_INT",
        "OB_PROP_COLOR_MIRROR_BOOL",
        "OB_PROP_COLOR_WHITE_BALANCE_INT",
        "OB_PROP_DEPTH_MIRROR_BOOL",
        "OB_PROP_IR_MIRROR_BOOL",
        "OB_PROP_LASER_BOOL",
        "OB_PROP_LASER_CONTROL_INT",
    ],
)


class OBMultiDeviceSyncConfig:
    def __init__(self) -> None:
        self.mode = OBMultiDeviceSyncMode.FREE_RUN
        self.trigger_out_enable = False
        self.trigger_to_image_delay_us = 0


class OBCameraIntrinsic(SimpleNamespace):
    """fx, fy, cx, cy, width, height."""


class OBCameraDistortion(SimpleNamespace):
    """model, k1 to k6, p1, p2."""


class OBExtrinsic(SimpleNamespace):
    """rot, and transform in mm."""


class VideoStreamProfile:
    def __init__(self, size: tuple[int, int], fps: int, form: OBFormat) -> None:
        self._size, self._fps, self._form = size, fps, form

    def as_video_stream_profile(self) -> VideoStreamProfile:
        return self

    def get_width(self) -> int:
        return self._size[0]

    def get_height(self) -> int:
        return self._size[1]

    def get_fps(self) -> int:
        return self._fps

    def get_format(self) -> OBFormat:
        return self._form

    def get_intrinsic(self) -> OBCameraIntrinsic:
        return OBCameraIntrinsic(
            **dict(zip(("fx", "fy", "cx", "cy", "width", "height"), (*LENS[:4], *self._size), strict=True))
        )

    def get_distortion(self) -> OBCameraDistortion:
        k1, k2, p1, p2 = LENS[4:]
        return OBCameraDistortion(
            model=OBCameraDistortionModel.BROWN_CONRADY_K6, k1=k1, k2=k2, k3=0.0, k4=0.0, k5=0.0, k6=0.0, p1=p1, p2=p2
        )

    def get_extrinsic_to(self, other: VideoStreamProfile) -> OBExtrinsic:
        return OBExtrinsic(
            rot=T_COLOR_DEPTH[:3, :3].astype(np.float32), transform=(1000 * T_COLOR_DEPTH[:3, 3]).astype(np.float32)
        )


class StreamProfileList:
    def __init__(self, profiles: list[VideoStreamProfile]) -> None:
        self._profiles = profiles

    def get_count(self) -> int:
        return len(self._profiles)

    def get_stream_profile_by_index(self, index: int) -> VideoStreamProfile:
        return self._profiles[index]


class Sensor:
    def __init__(self, profiles: list[VideoStreamProfile]) -> None:
        self._profiles = profiles

    def get_stream_profile_list(self) -> StreamProfileList:
        return StreamProfileList(self._profiles)


class DepthFrame:
    """Also of colour and infrared, whose classes have no scale."""

    def __init__(self, pixels: np.ndarray, form: OBFormat, device_us: int, number: int, scale_mm: float) -> None:
        self._pixels, self._form, self._us, self._number, self._scale_mm = pixels, form, device_us, number, scale_mm

    def get_data(self) -> np.ndarray:
        return np.frombuffer(self._pixels.tobytes(), np.uint8)

    def get_format(self) -> OBFormat:
        return self._form

    def get_width(self) -> int:
        return self._pixels.shape[1]

    def get_height(self) -> int:
        return self._pixels.shape[0]

    def get_timestamp_us(self) -> int:
        return self._us

    def get_index(self) -> int:
        return self._number

    def get_depth_scale(self) -> float:
        return self._scale_mm


class FrameSet:
    def __init__(self, frames: dict[str, DepthFrame]) -> None:
        self._frames = frames

    def get_color_frame(self) -> DepthFrame | None:
        return self._frames.get("color")

    def get_depth_frame(self) -> DepthFrame | None:
        return self._frames.get("depth")

    def get_ir_frame(self) -> DepthFrame | None:
        return self._frames.get("ir")


class Config:
    def __init__(self) -> None:
        self.enabled: list[VideoStreamProfile] = []

    def enable_stream(self, arg0: VideoStreamProfile) -> None:
        self.enabled.append(arg0)

    def set_align_mode(self, arg0: OBAlignMode) -> None:
        pass

    def set_frame_aggregate_output_mode(self, arg0: OBFrameAggregateOutputMode) -> None:
        pass


class Pipeline:
    def __init__(self, device: Device) -> None:
        self._camera = device._camera

    def start(self, arg0: Config) -> None:
        self._camera.enabled = arg0.enabled

    def stop(self) -> None:
        self._camera.enabled = []

    def wait_for_frames(self, arg0: int) -> FrameSet | None:
        try:
            return self._camera.waiting.get(timeout=arg0 / 1000)
        except queue.Empty:
            return None


class DeviceInfo:
    def __init__(self, camera: SoftOrbbec) -> None:
        self._camera = camera

    def get_name(self) -> str:
        return "Orbbec Femto Bolt"

    def get_serial_number(self) -> str:
        return self._camera.serial

    def get_firmware_version(self) -> str:
        return "1.1.2"


class Device:
    def __init__(self, camera: SoftOrbbec) -> None:
        self._camera = camera

    def get_device_info(self) -> DeviceInfo:
        return DeviceInfo(self._camera)

    def get_sensor(self, arg0: OBSensorType) -> Sensor:
        if arg0 not in self._camera.offered:
            raise OBError("No matched sensor found")
        return Sensor(self._camera.offered[arg0])

    def is_property_supported(self, arg0: OBPropertyID, arg1: OBPermissionType) -> bool:
        return arg0 in self._camera.properties

    def get_bool_property(self, arg0: OBPropertyID) -> bool:
        return bool(self._camera.property(arg0))

    def get_int_property(self, arg0: OBPropertyID) -> int:
        return int(self._camera.property(arg0))

    def set_bool_property(self, arg0: OBPropertyID, arg1: bool) -> None:
        self._camera.property(arg0)
        self._camera.properties[arg0] = arg1

    def set_int_property(self, arg0: OBPropertyID, arg1: int) -> None:
        self.set_bool_property(arg0, arg1)

    def get_supported_multi_device_sync_mode_bitmap(self) -> int:
        return 1 | 4 | 8 if self._camera.cable else 1

    def get_multi_device_sync_config(self) -> OBMultiDeviceSyncConfig:
        made = OBMultiDeviceSyncConfig()
        made.__dict__.update(self._camera.sync.__dict__)
        return made

    def set_multi_device_sync_config(self, arg0: OBMultiDeviceSyncConfig) -> None:
        self._camera.sync = arg0


class DeviceList:
    def __init__(self, cameras: list[SoftOrbbec]) -> None:
        self._cameras = cameras

    def get_count(self) -> int:
        return len(self._cameras)

    def get_device_uid_by_index(self, arg0: int) -> str:
        return f"9{arg0}-1.2-1"

    def get_device_serial_number_by_index(self, arg0: int) -> str:
        return self._cameras[arg0].serial

    def get_device_by_serial_number(self, serial_number: str) -> Device:
        for camera in self._cameras:
            if camera.serial == serial_number:
                return Device(camera)
        raise OBError(f"Device not found by serial number: {serial_number}")


class Context:
    def __init__(self, attached: list[SoftOrbbec]) -> None:
        self._attached = attached

    def query_devices(self) -> DeviceList:
        return DeviceList(self._attached)

    @staticmethod
    def set_logger_level(arg0: OBLogLevel) -> None:
        pass


def get_version() -> str:
    return "2.9.3"


class SoftOrbbec(SoftCamera):
    """`cable`: it has the modes of synchronisation."""

    sizes: ClassVar = {"color": (1280, 960), "depth": (640, 576)}
    unit_m = 0.00025
    prefix = "orbbec:"

    def __init__(self, serial: str, fps: int = 30, cable: bool = False, depth: bool = True) -> None:
        super().__init__(serial, depth)
        self.cable, self.sync = cable, OBMultiDeviceSyncConfig()
        self.waiting: queue.SimpleQueue[FrameSet] = queue.SimpleQueue()
        self.enabled: list[VideoStreamProfile] = []
        ids = OBPropertyID
        self.properties = {
            ids.OB_PROP_COLOR_AUTO_EXPOSURE_BOOL: False,
            ids.OB_PROP_COLOR_AUTO_WHITE_BALANCE_BOOL: False,
            ids.OB_PROP_COLOR_EXPOSURE_INT: 156,
            ids.OB_PROP_COLOR_WHITE_BALANCE_INT: 4504,
            ids.OB_PROP_COLOR_MIRROR_BOOL: True,
        }
        colors = [((3840, 2160), "MJPG"), ((1280, 960), "MJPG"), ((1280, 960), "RGB"), ((640, 360), "RGB")]
        self.offered = {
            OBSensorType.COLOR_SENSOR: [VideoStreamProfile(size, fps, OBFormat[name]) for size, name in colors],
            OBSensorType.DEPTH_SENSOR: [
                VideoStreamProfile((1024, 1024), 15, OBFormat.Y16),
                VideoStreamProfile((640, 576), fps, OBFormat.Y16),
            ],
            OBSensorType.IR_SENSOR: [VideoStreamProfile((640, 576), fps, OBFormat.Y16)],
        }
        if not depth:
            del self.offered[OBSensorType.DEPTH_SENSOR], self.offered[OBSensorType.IR_SENSOR]

    @property
    def automatic(self) -> tuple[bool, bool]:
        ids = OBPropertyID
        one, other = ids.OB_PROP_COLOR_AUTO_EXPOSURE_BOOL, ids.OB_PROP_COLOR_AUTO_WHITE_BALANCE_BOOL
        return bool(self.properties[one]), bool(self.properties[other])

    @property
    def sync_place(self) -> int | None:
        modes = OBMultiDeviceSyncMode
        return {modes.FREE_RUN: None, modes.PRIMARY: 0, modes.SECONDARY: 1}[self.sync.mode]

    def property(self, one: OBPropertyID) -> int:
        if one not in self.properties:
            raise OBError(f"{one.name}: not supported")
        return self.properties[one]

    def deliver(self, frames: dict, device_us: int, number: int) -> None:
        if not self.enabled:
            return
        form = {"color": OBFormat.RGB, "depth": OBFormat.Y16, "ir": OBFormat.Y16}
        if "depth" in frames:
            frames = {**frames, "ir": frames["depth"] // 8}
        kinds = {OBFormat.Y16: ("depth", "ir")}
        streamed = {kind for profile in self.enabled for kind in kinds.get(profile.get_format(), ("color",))}
        made = {
            kind: DepthFrame(image, form[kind], device_us, number, 1000 * self.unit_m)
            for kind, image in frames.items()
            if kind in streamed
        }
        self.waiting.put(FrameSet(made))

    @staticmethod
    def driver(attached: list[SoftOrbbec]) -> OrbbecCameras:
        import soft_orbbec

        return OrbbecCameras(soft_orbbec, Context(attached))

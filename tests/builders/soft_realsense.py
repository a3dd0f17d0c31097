"""RealSense cameras without hardware: librealsense's software devices."""

from __future__ import annotations

from typing import ClassVar

from soft_cameras import LENS, T_COLOR_DEPTH, SoftCamera

from rgbd_calib.sensors.realsense import RealSense


class SoftRealSense(SoftCamera):
    """`cable`: it has the modes of synchronisation."""

    sizes: ClassVar = {"color": (640, 480), "depth": (848, 480)}
    unit_m = 0.00025
    prefix = "realsense:"

    def __init__(self, serial: str, fps: int = 30, cable: bool = False, depth: bool = True) -> None:
        import pyrealsense2 as rs

        super().__init__(serial, depth)
        self.rs, self.handle = rs, rs.software_device()
        self.handle.register_info(rs.camera_info.serial_number, serial)
        self.handle.register_info(rs.camera_info.name, "Software")
        names = {"color": "RGB Camera"} | ({"depth": "Stereo Module"} if depth else {})
        self.sensors = {kind: self.handle.add_sensor(name) for kind, name in names.items()}
        self.fps = fps
        self.profiles = {kind: self._profile(kind, self.sizes[kind]) for kind in self.sensors}
        self._option("color", rs.option.enable_auto_exposure, 1.0, 0.0)
        self._option("color", rs.option.enable_auto_white_balance, 1.0, 0.0)
        self._option("color", rs.option.exposure, 10000.0, 156.0)
        self._option("color", rs.option.white_balance, 6500.0, 4600.0)
        if not depth:
            return
        pose = rs.extrinsics()
        pose.rotation = list(T_COLOR_DEPTH[:3, :3].T.ravel())  # columns
        pose.translation = list(T_COLOR_DEPTH[:3, 3])
        self.profiles["depth"].register_extrinsics_to(self.profiles["color"], pose)
        self.sensors["depth"].add_read_only_option(rs.option.depth_units, self.unit_m)
        if cable:
            self._option("depth", rs.option.inter_cam_sync_mode, 2.0, 0.0)

    @property
    def automatic(self) -> tuple[bool, bool]:
        option, sensor = self.rs.option, self.sensors["color"]
        return (
            sensor.get_option(option.enable_auto_exposure) == 1.0,
            sensor.get_option(option.enable_auto_white_balance) == 1.0,
        )

    @property
    def sync_place(self) -> int | None:
        mode = self.sensors["depth"].get_option(self.rs.option.inter_cam_sync_mode)
        return {0.0: None, 1.0: 0, 2.0: 1}[mode]

    def deliver(self, frames: dict, device_us: int, number: int) -> None:
        for kind in self.sensors.keys() & frames.keys():
            pixels = frames[kind]
            size = pixels.shape[1::-1]
            profile = self.profiles[kind] if size == self.sizes[kind] else self._profile(kind, size)
            frame = self.rs.software_video_frame()
            frame.pixels, frame.bpp = pixels, 3 if kind == "color" else 2
            frame.stride = pixels.shape[1] * frame.bpp
            frame.timestamp, frame.domain = device_us / 1000, self.rs.timestamp_domain.hardware_clock
            frame.frame_number, frame.profile = number, profile.as_video_stream_profile()
            self.sensors[kind].on_video_frame(frame)

    def _option(self, kind: str, option, most: float, value: float) -> None:
        allowed = self.rs.option_range()
        allowed.min, allowed.max, allowed.step, allowed.default = 0.0, most, 1.0, value
        self.sensors[kind].add_option(option, allowed, True)

    def _profile(self, kind: str, size: tuple[int, int]):
        rs = self.rs
        stream, form, bpp = (
            (rs.stream.color, rs.format.rgb8, 3) if kind == "color" else (rs.stream.depth, rs.format.z16, 2)
        )
        lens = rs.intrinsics()
        lens.width, lens.height = size
        lens.fx, lens.fy, lens.ppx, lens.ppy = LENS[:4]
        lens.model, lens.coeffs = rs.distortion.brown_conrady, [*LENS[4:8], 0.0]
        video = rs.video_stream()
        video.type, video.index, video.uid, video.fps = stream, 0, int(stream), self.fps
        video.width, video.height, video.bpp, video.fmt, video.intrinsics = *size, bpp, form, lens
        return self.sensors[kind].add_video_stream(video)

    @staticmethod
    def driver(attached: list[SoftRealSense]) -> RealSense:
        import pyrealsense2

        return RealSense(pyrealsense2, lambda: [camera.handle for camera in attached])

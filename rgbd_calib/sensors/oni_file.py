"""OpenNI recordings (.oni), played by the runtime as fast as they are read.

Such a file lacks the serial number, whether depth was registered, and the cameras' common clock: each starts at 0.
Seeking in one hangs, so it is played from start to end, twice: once for the times, once for the pictures.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.foreign.source import Kind, Picture, Stamps
from rgbd_calib.sensors.frames import SensorFrame
from rgbd_calib.sensors.openni2 import Runtime

_END_S = 2.0  # silence that means the end, where the file holds fewer frames than it says


class OniFile:
    """One camera from an .oni file."""

    def __init__(self, path: Path, camera: str, runtime: Runtime) -> None:
        if not path.is_file():
            raise ConfigError(f"{path}: no such file")
        self.name = str(path)
        self.intrinsics: Mapping[str, Intrinsics] = {}
        self._camera = camera
        self._path = path
        self._runtime = runtime
        self._stamps: dict[Kind, list[int]] = {"color": [], "depth": []}
        self._mirrored = False
        self.depth_scale = 0.001
        frames = [(frame.kind, frame.device_us) for frame in self._play()]
        for kind, time_us in frames:
            self._stamps[kind].append(time_us)
        if not self._stamps["color"]:
            raise CalibrationError(
                f"{path}: no colour frame in it ({len(self._stamps['depth'])} depth frames); a calibration needs colour. "
                "Record it again with both streams"
            )
        self.remarks = self._remarks()

    def stamps(self) -> Mapping[str, Stamps]:
        return {self._camera: self._stamps}

    def pictures(self) -> Iterator[Picture]:
        counts: dict[Kind, int] = {"color": 0, "depth": 0}
        for frame in self._play():
            pixels = frame.pixels[:, ::-1] if self._mirrored else frame.pixels
            if frame.kind == "color":
                pixels = pixels[..., ::-1]
            yield Picture(self._camera, frame.kind, counts[frame.kind], np.ascontiguousarray(pixels))
            counts[frame.kind] += 1

    def _play(self) -> Iterator[SensorFrame]:
        """Every frame; the device is closed at the end of each play: nothing seeks back."""
        device = self._runtime.open(str(self._path.absolute()))
        try:
            device.create_streams()
            self._mirrored = device.is_mirrored()
            self.depth_scale = device.depth_unit_m()
            left = sum(device.frame_count().values())
            device.play_as_fast_as_read()
            device.start()
            while left > 0 and (frame := device.wait_frame(_END_S)) is not None:
                left -= 1
                yield frame
        finally:
            device.close()

    def _remarks(self) -> tuple[str, ...]:
        remarks = [
            f"{self.name}: an .oni file does not say whether depth was registered to colour; it is taken as registered. If it "
            "was not, import colour alone (--color-only)"
        ]
        if self._mirrored:
            remarks.append(f"{self.name}: its pictures are mirrored; they are turned back")
        return tuple(remarks)

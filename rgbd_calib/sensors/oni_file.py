"""OpenNI recordings (.oni), played by the runtime, in a process of its own, as fast as they are read.

Such a file lacks the serial number, whether depth was registered, and the cameras' common clock: each starts at 0.
Seeking in one hangs, so it is played from start to end, twice: once for the times, once for the pictures.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.io.foreign.source import Kind, Source, SourceCamera, SourceImage, Stamps, Wanted
from rgbd_calib.sensors.frames import SensorFrame
from rgbd_calib.sensors.oni_player import OniHead, play


class OniFile(Source):
    """One camera from an .oni file."""

    def __init__(self, path: Path, camera: str, redist: Path | None = None) -> None:
        if not path.is_file():
            raise ConfigError(f"{path}: no such file")
        self.name = str(path)
        self._camera = camera
        self._path = path
        self._redist = redist
        self._stamps: dict[Kind, list[int]] = {"color": [], "depth": []}
        self._mirrored, self._depth_scale = False, 0.001
        for frame in self._play():
            self._stamps[frame.kind].append(frame.device_us)
        if not self._stamps["color"]:
            raise CalibrationError(
                f"{path}: no colour frame in it ({len(self._stamps['depth'])} depth frames); a calibration needs colour. "
                "Record it again with both streams"
            )
        self.cameras = {camera: SourceCamera(depth_scale=self._depth_scale)}
        self.remarks = (f"{self.name}: its pictures are mirrored; they are turned back",) if self._mirrored else ()

    def stamps(self) -> Mapping[str, Stamps]:
        return {self._camera: self._stamps}

    def pictures(self, wanted: Wanted) -> Iterator[SourceImage]:
        counts: dict[Kind, int] = {"color": -1, "depth": -1}
        for frame in self._play():
            counts[frame.kind] += 1
            if not wanted(self._camera, frame.kind, counts[frame.kind]):
                continue
            pixels = frame.pixels[:, ::-1] if self._mirrored else frame.pixels
            if frame.kind == "color":
                pixels = pixels[..., ::-1]
            yield SourceImage(self._camera, frame.kind, counts[frame.kind], np.ascontiguousarray(pixels))

    def _play(self) -> Iterator[SensorFrame]:
        """Every frame; nothing seeks back."""
        for got in play(self._path, self._redist):
            if isinstance(got, OniHead):
                self._mirrored, self._depth_scale = got.mirrored, got.depth_unit_m
            else:
                yield got

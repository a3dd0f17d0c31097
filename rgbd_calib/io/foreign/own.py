"""Recordings of this program as a source: to join their frames otherwise, by time or by order."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path

from rgbd_calib.io.foreign.pictures import read_picture
from rgbd_calib.io.foreign.source import Kind, Source, SourceCamera, SourceImage, Stamps, Stems, Wanted
from rgbd_calib.io.layout import KINDS
from rgbd_calib.io.recording import CameraInfo, open_recording


def is_own(path: Path) -> bool:
    return (path / "dataset.yaml").is_file()


class OwnRecording(Source):
    """The cameras of a recording, under their names."""

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self._recording = open_recording(path)
        self._listed = (self._recording.color_files, self._recording.depth_files, self._recording.ir_files)
        self.cameras = {c: _source_camera(info) for c, info in self._recording.cameras.items()}
        self.remarks = self._recording.remarks
        self.board = self._recording.board

    def stamps(self) -> Mapping[str, Stamps]:
        """Of the kinds all of whose images have a time; infrared images have that of depth."""
        return {c: own for c in self.cameras if (own := self._stamps_of(c))}

    def stems(self) -> Mapping[str, Stems]:
        return {
            c: {kind: list(files[c]) for kind, files in zip(KINDS, self._listed, strict=True) if files[c]}
            for c in self.cameras
        }

    def pictures(self, wanted: Wanted) -> Iterator[SourceImage]:
        for kind, files in zip(KINDS, self._listed, strict=True):
            for camera, of_camera in files.items():
                for index, path in enumerate(of_camera.values()):
                    if wanted(camera, kind, index):
                        yield SourceImage(camera, kind, index, read_picture(path, kind))

    def _stamps_of(self, camera: str) -> dict[Kind, list[int]]:
        times = self._recording.timestamps_us(camera)
        if not times:
            return {}
        out: dict[Kind, list[int]] = {}
        for kind, files in zip(KINDS, self._listed, strict=True):
            own = [times.get(frame, (math.nan, math.nan))[kind != "color"] for frame in files[camera]]
            if all(map(math.isfinite, own)):
                out[kind] = [round(time_us) for time_us in own]
        return out


def _source_camera(info: CameraInfo) -> SourceCamera:
    own = info.depth
    return SourceCamera(
        info.intrinsics,
        info.serial,
        info.depth_scale,
        own is None,
        None if own is None else own.intrinsics,
        None if own is None else own.T_color_depth,
        info.float_unit_m,
        info.invalid,
    )

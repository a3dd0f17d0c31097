"""Recordings of Azure Kinect and Orbbec Femto, .mkv of k4arecorder: tracks COLOR (MJPEG), DEPTH and IR (16 bits, big-endian),
the calibration attached as JSON, and the start of the device's clock in the tags.

https://learn.microsoft.com/azure/kinect-dk/record-file-format
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.calibrations.azure_ import read_device
from rgbd_calib.io.foreign.source import Encoded, Kind, Source, SourceCamera, SourceImage, Stamps, Wanted
from rgbd_calib.io.foreign.video_file import open_video, video_faults
from rgbd_calib.io.schema_base import MAX_SIDE

_TRACKS: dict[str, Kind] = {"COLOR": "color", "DEPTH": "depth", "IR": "ir"}
_EBML = b"\x1a\x45\xdf\xa3"
DEPTH_SCALE = 0.001
"""Fixed by the format: millimetres."""


def is_azure(path: Path) -> bool:
    """True for a Matroska file that names its tracks as k4arecorder does."""
    if path.suffix.lower() != ".mkv" or not path.is_file():
        return False
    with path.open("rb") as stream:
        head = stream.read(1 << 20)
    return head.startswith(_EBML) and b"K4A_" in head


class AzureMkv(Source):
    """One camera."""

    def __init__(self, path: Path, camera: str) -> None:
        self.name = str(path)
        self._path, self._camera = path, camera
        remarks: list[str] = []
        with open_video(path) as file, video_faults(path):
            tags = {str(k): str(v) for k, v in file.metadata.items()}
            self._offset_us = _whole(tags.get("K4A_START_OFFSET_NS")) // 1000
            self._tracks: dict[int, Kind] = {}
            sizes: dict[Kind, tuple[int, int]] = {}
            attached: dict[str, bytes] = {}
            for stream in file.streams:
                if stream.type == "attachment":
                    attached[str(stream.name)] = bytes(stream.data)
                    continue
                kind = _TRACKS.get(str(stream.metadata.get("title", "")).upper())
                if stream.type != "video" or kind is None or kind in sizes:
                    remarks.append(f"{path}: track {stream.metadata.get('title', stream.index)} is not used")
                    continue
                self._tracks[stream.index], sizes[kind] = kind, (int(stream.width), int(stream.height))
        if "color" not in sizes:
            raise ConfigError(f"{path}: no colour track in it; a calibration needs colour. Record both")
        if "depth" in sizes and sizes.get("ir", sizes["depth"]) != sizes["depth"]:
            raise ConfigError(f"{path}: depth and infrared of different sizes seen. Is it complete?")
        if max(max(size) for size in sizes.values()) > MAX_SIDE:
            raise ConfigError(f"{path}: images of more than {MAX_SIDE} px a side seen. Is it damaged?")
        self._sizes = sizes
        self.cameras = {camera: self._read_camera(attached, tags, remarks)}
        if tags.get("K4A_WIRED_SYNC_MODE", "STANDALONE") != "STANDALONE":
            self.clock = "K4A wired"
        self.remarks = tuple(remarks)
        self._stamps: dict[Kind, list[int]] = {}

    def stamps(self) -> Mapping[str, Stamps]:
        if not self._stamps:
            self._stamps = {kind: [] for kind in self._tracks.values()}
            for kind, time_us, _ in self._packets():
                self._stamps[kind].append(time_us)
        return {self._camera: self._stamps}

    def pictures(self, wanted: Wanted) -> Iterator[SourceImage]:
        counts: dict[Kind, int] = dict.fromkeys(self._tracks.values(), 0)
        for kind, _, data in self._packets():
            index = counts[kind]
            counts[kind] += 1
            if wanted(self._camera, kind, index):
                yield SourceImage(self._camera, kind, index, self._decode(kind, data, index))

    def _packets(self) -> Iterator[tuple[Kind, int, bytes]]:
        """(kind, device time in us, bytes) of every frame."""
        with open_video(self._path) as file:
            streams = [s for s in file.streams if s.index in self._tracks]
            packets = file.demux(streams)
            while True:
                with video_faults(self._path):
                    packet = next(packets, None)
                    if packet is None:
                        return
                    if packet.pts is None or not packet.size:
                        continue
                    kind = self._tracks[packet.stream.index]
                    time_us = round(1e6 * packet.pts * packet.time_base) + self._offset_us
                    data = bytes(packet)
                yield kind, time_us, data

    def _decode(self, kind: Kind, data: bytes, index: int) -> np.ndarray | Encoded:
        where = f"{self.name}: {kind} frame {index}"
        width, height = self._sizes[kind]
        if kind == "color":
            if not data.startswith(b"\xff\xd8"):
                raise ConfigError(f"{where}: no JPEG. Record colour as MJPG, or convert it with k4arecorder's tools")
            return Encoded(data, ".jpg")
        if len(data) != 2 * width * height:
            raise ConfigError(f"{where}: {len(data)} bytes seen, {2 * width * height} needed. Is it complete?")
        return np.frombuffer(data, ">u2").reshape(height, width).astype(np.uint16)

    def _read_camera(self, attached: Mapping[str, bytes], tags: Mapping[str, str], remarks: list[str]) -> SourceCamera:
        serial = tags.get("K4A_DEVICE_SERIAL_NUMBER")
        name = next((n for n in attached if n.endswith(".json")), None)
        if name is None:
            remarks.append(f"{self.name}: no calibration is attached to it: its lenses are not known")
            return SourceCamera(None, serial, DEPTH_SCALE, False)
        where = Path(f"{self.name}/{name}")
        try:
            tree = json.loads(attached[name].rstrip(b"\0").decode("utf-8"))
        except (ValueError, RecursionError) as error:
            raise ConfigError(f"{where}: cannot be read as JSON ({str(error)[:200]}). Is the file complete?") from None
        depth_size = self._sizes.get("depth", self._sizes.get("ir"))
        found = read_device(where, tree, self._sizes["color"], depth_size)
        if found.depth is None:
            return SourceCamera(found.intrinsics, serial)
        own = found.depth
        return SourceCamera(found.intrinsics, serial, DEPTH_SCALE, False, own.intrinsics, own.T_color_depth)


def _whole(text: str | None) -> int:
    return int(text) if text is not None and text.isdigit() and len(text) < 20 else 0

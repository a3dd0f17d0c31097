"""Recordings of Orbbec cameras, .bag of the Orbbec SDK (ROS 1): /cam/sensor_N/frameType_N, profiles in messages of their own.

streamProfileType_3 is depth's: rotationMatrix and translationMatrix (mm) take its points to colour; cameraDistortion is k1 to
k6, p1, p2. https://github.com/orbbec/OrbbecSDK_v2 (src/media/ros)
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.calibrations.common import numbers, rigid
from rgbd_calib.io.calibrations.makers_lens import ORBBEC, lens_of_maker
from rgbd_calib.io.foreign.bag import Bag, bag_faults, open_bag, stamp_us
from rgbd_calib.io.foreign.orbbec_bag import FRAME
from rgbd_calib.io.foreign.ros_images import picture_of
from rgbd_calib.io.foreign.source import Kind, Source, SourceCamera, SourceImage, Stamps, Wanted

_KINDS: dict[str, Kind] = {"2": "color", "3": "depth", "1": "ir", "6": "ir"}
"""By OBSensorType: colour, depth, infrared, left infrared."""
_PROFILES = {"color": "2", "depth": "3"}


class OrbbecBag(Source):
    """One camera."""

    def __init__(self, path: Path, camera: str) -> None:
        self.name = str(path)
        self._path, self._camera = path, camera
        self._stamps: dict[Kind, list[int]] = {}
        remarks: list[str] = []
        with open_bag(path) as bag:
            self._streams: dict[str, Kind] = {}
            for topic in sorted(bag.types):
                frame = FRAME.fullmatch(topic)
                kind = None if frame is None else _KINDS.get(frame[1])
                if kind is not None and kind not in self._streams.values():
                    self._streams[topic] = kind
                elif frame is not None:
                    remarks.append(f"{path}: {topic} is not used")
            if "color" not in self._streams.values():
                raise ConfigError(f"{path}: no colour stream in it; a calibration needs colour. Record both")
            self.cameras = {camera: self._read_camera(bag, remarks)}
        self.remarks = tuple(remarks)

    def stamps(self) -> Mapping[str, Stamps]:
        if not self._stamps:
            found: dict[Kind, list[int]] = defaultdict(list)
            with open_bag(self._path) as bag:
                for topic, _, read in bag.messages(self._streams.__contains__):
                    message = read()
                    with bag_faults(self.name):
                        found[self._streams[topic]].append(
                            int(getattr(message, "timestamp_usec", 0)) or stamp_us(message)
                        )
            self._stamps = dict(found)
        return {self._camera: self._stamps}

    def pictures(self, wanted: Wanted) -> Iterator[SourceImage]:
        counts: dict[Kind, int] = defaultdict(int)
        with open_bag(self._path) as bag:
            for topic, _, read in bag.messages(self._streams.__contains__):
                kind = self._streams[topic]
                index = counts[kind]
                counts[kind] += 1
                if wanted(self._camera, kind, index):
                    message = read()
                    with bag_faults(f"{self.name}: {topic}"):
                        yield SourceImage(self._camera, kind, index, picture_of(message, kind, f"{self.name}: {topic}"))

    def _read_camera(self, bag: Bag, remarks: list[str]) -> SourceCamera:
        profiles = {kind: self._profile(bag, number) for kind, number in _PROFILES.items()}
        color = None if profiles["color"] is None else self._lens(profiles["color"], "color", remarks)
        device = bag.first("/cam/deviceInfo") if "/cam/deviceInfo" in bag.types else None
        serial = None if device is None else str(getattr(device, "sn", "")) or None
        own = profiles["depth"]
        if "depth" not in self._streams.values() or own is None:
            return SourceCamera(color, serial)
        depth = self._lens(own, "depth", remarks)
        with bag_faults(self.name):
            R = numbers(self._path, "rotationMatrix", own.rotationMatrix, 9).reshape(3, 3)
            t = numbers(self._path, "translationMatrix", own.translationMatrix, 3) / 1000
            T = rigid(self._path, "streamProfileType_3", R, t) if np.any(R) else None
        aligned = color is not None and color == depth
        return SourceCamera(color, serial, None, aligned, None if aligned else depth, None if aligned else T)

    def _profile(self, bag: Bag, number: str) -> Any | None:
        topic = f"/cam/streamProfileType_{number}"
        return bag.first(topic) if topic in bag.types else None

    def _lens(self, profile: Any, kind: str, remarks: list[str]) -> Intrinsics | None:
        with bag_faults(f"{self.name}: lens of {kind}"):
            fx, fy, cx, cy = numbers(self._path, f"{kind}: cameraIntrinsic", profile.cameraIntrinsic, 4)
            k1, k2, k3, k4, k5, k6, p1, p2 = numbers(
                self._path, f"{kind}: cameraDistortion", profile.cameraDistortion, 8
            )
            number = int(profile.distortionModel)
            if not fx > 0:
                return None
            model = ORBBEC[number] if 0 <= number < len(ORBBEC) else str(number)
            k = (k1, k2, k3, k4) if model == "kannala" else (k1, k2, p1, p2, k3, k4, k5, k6)
            size = (int(profile.width), int(profile.height))
            found, note = lens_of_maker(self._path, f"{self._camera} {kind}", size, (fx, fy), (cx, cy), model, k)
        if note:
            remarks.append(f"{self.name}: {note}")
        return found

"""Native recordings of RealSense cameras: .bag (ROS 1, file version 3) and .db3 (ROS 2, file version 4) of librealsense.

Topics are /device_D/sensor_S/STREAM_I/...; lenses, depth unit, serial number and extrinsics are in messages of their own,
in the .db3 as text `key=value;...`. Extrinsics take points of the reference stream to the stream (checked against the
library's own playback). Depth is in its own geometry unless it was recorded aligned.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.calibrations.common import numbers, rigid
from rgbd_calib.io.calibrations.makers_lens import lens_of_maker
from rgbd_calib.io.foreign.bag import Bag, bag_faults, matrices, motion, open_bag, stamp_us
from rgbd_calib.io.foreign.ros_images import picture_of
from rgbd_calib.io.foreign.source import Kind, Source, SourceCamera, SourceImage, Stamps, Wanted

_IMAGE = re.compile(r"/(device_\d+)/(sensor_\d+)/(\w+?)_(\d+)/image/data(/compressed(?:Depth)?)?")
_KINDS: dict[str, Kind] = {"color": "color", "depth": "depth", "infrared": "ir", "infrared1": "ir"}


def is_realsense(topics: Mapping[str, str]) -> bool:
    """True for the topics of a recording by librealsense."""
    return any(_IMAGE.fullmatch(topic) for topic in topics)


class RealSenseBag(Source):
    """The devices of one recording: one camera each.

    Parameters
    ----------
    camera
        The name of its only device; several are called after their numbers.
    """

    def __init__(self, path: Path, camera: str) -> None:
        self.name = str(path)
        self._path = path
        self._stamps: dict[str, dict[Kind, list[int]]] = {}
        with open_bag(path) as bag:
            found = {topic: m for topic in sorted(bag.types) if (m := _IMAGE.fullmatch(topic))}
            devices = sorted({m[1] for m in found.values()})
            names = {devices[0]: camera} if len(devices) == 1 else {d: d for d in devices}
            remarks: list[str] = []
            self._streams: dict[str, tuple[str, Kind]] = {}
            for topic, m in found.items():
                kind, taken = _KINDS.get(m[3].lower()), set(self._streams.values())
                if kind is None or (names[m[1]], kind) in taken:
                    remarks.append(f"{path}: stream {topic} is not used")
                else:
                    self._streams[topic] = (names[m[1]], kind)
            self.cameras = {names[d]: self._camera(bag, d, names[d], remarks) for d in devices}
        for name in self.cameras:
            if (name, "color") not in self._streams.values():
                raise ConfigError(f"{path}: {name}: no colour stream in it; a calibration needs colour. Record both")
        self.remarks = tuple(remarks)

    def stamps(self) -> Mapping[str, Stamps]:
        if self._stamps:
            return self._stamps
        device: dict[str, list[float | None]] = defaultdict(list)
        host: dict[str, list[float | None]] = defaultdict(list)
        domains: dict[str, set[str]] = defaultdict(set)
        metadata = {t.partition("/image/")[0] + "/image/metadata": t for t in self._streams}
        with open_bag(self._path) as bag:
            for topic, _, read in bag.messages(lambda t: t in self._streams or t in metadata):
                message = read()
                with bag_faults(self.name):
                    if topic in self._streams:
                        device[topic].append(stamp_us(message))
                        host[topic].append(None)
                        continue
                    own = metadata[topic]
                    for key, value in _pairs(message):
                        if key == "timestamp_domain":
                            domains[own].add(value)
                        elif key == "system_time" and host[own]:
                            host[own][-1] = 1000 * float(value)
                        elif key == "timestamp" and device[own]:
                            device[own][-1] = 1000 * float(value)
        self._stamps = {camera: self._clock(camera, device, host, domains) for camera in self.cameras}
        return self._stamps

    def _clock(
        self,
        camera: str,
        device: Mapping[str, list[float | None]],
        host: Mapping[str, list[float | None]],
        domains: Mapping[str, set[str]],
    ) -> dict[Kind, list[int]]:
        """The device's time where all streams have it, else the host's."""
        topics = {kind: topic for topic, (name, kind) in self._streams.items() if name == camera}
        used = [topic for topic in topics.values() if device.get(topic)]
        one = len({frozenset(domains.get(topic, ())) for topic in used}) <= 1
        hosted = all(value is not None and value > 0 for topic in used for value in host[topic])
        if not one and hosted:
            self.remarks += (f"{self.name}: {camera}: its streams have different clocks: the host's times are used",)
        times = host if not one and hosted else device
        return {kind: [round(v or 0) for v in times.get(topic, [])] for kind, topic in topics.items()}

    def pictures(self, wanted: Wanted) -> Iterator[SourceImage]:
        counts: dict[str, int] = defaultdict(int)
        with open_bag(self._path) as bag:
            for topic, _, read in bag.messages(self._streams.__contains__):
                camera, kind = self._streams[topic]
                index = counts[topic]
                counts[topic] += 1
                if wanted(camera, kind, index):
                    message = read()
                    with bag_faults(f"{self.name}: {topic}"):
                        yield SourceImage(camera, kind, index, picture_of(message, kind, f"{self.name}: {topic}"))

    def _camera(self, bag: Bag, device: str, camera: str, remarks: list[str]) -> SourceCamera:
        topics = {kind: topic for topic, (name, kind) in self._streams.items() if name == camera}
        base = {kind: topic.partition("/image/")[0] for kind, topic in topics.items()}
        lenses = {kind: self._lens(bag, f"{camera} {kind}", own, remarks) for kind, own in base.items()}
        info = _dictionary(bag, f"/{device}/info")
        if "depth" not in base:
            return SourceCamera(lenses.get("color"), info.get("Serial Number"))
        sensor = base["depth"].rpartition("/")[0]
        unit = _option(bag, sensor, ("Depth Units", "Depth_Units"))
        T_depth = self._to_stream(bag, base["depth"])
        T_color = self._to_stream(bag, base["color"]) if "color" in base else None
        T = None if T_depth is None or T_color is None else T_color @ se3.inverse(T_depth)
        color, depth = lenses.get("color"), lenses["depth"]
        # librealsense gives aligned depth the colour stream's lens
        aligned = color is not None and color == depth and (T is None or bool(np.allclose(T, np.eye(4), atol=1e-6)))
        return SourceCamera(color, info.get("Serial Number"), unit, aligned, None if aligned else depth, T)

    def _lens(self, bag: Bag, name: str, base: str, remarks: list[str]) -> Intrinsics | None:
        for topic in (f"{base}/info/camera_info", f"{base}/camera_info"):
            message = bag.first(topic) if topic in bag.types else None
            if message is None:
                continue
            with bag_faults(f"{self.name}: {topic}"):
                if hasattr(message, "height"):
                    K, D = matrices(message)
                    size, model = (int(message.width), int(message.height)), str(message.distortion_model)
                    focal, centre = (K[0], K[4]), (K[2], K[5])
                else:
                    own = dict(_pairs(message))
                    size, model = (int(own["width"]), int(own["height"])), own["model"]
                    focal = (float(own["fx"]), float(own["fy"]))
                    centre = (float(own["ppx"]), float(own["ppy"]))
                    D = np.array([float(v) for v in own["coeffs"].split(",")])
                found, note = lens_of_maker(self._path, name, size, focal, centre, model, D)
            if note:
                remarks.append(f"{self.name}: {note}")
            return found
        return None

    def _to_stream(self, bag: Bag, base: str) -> FloatArray | None:
        """T_stream_reference of a stream."""
        topic = next((t for t in sorted(bag.types) if t.startswith(f"{base}/tf/")), None)
        message = None if topic is None else bag.first(topic)
        if message is None or topic is None:
            return None
        with bag_faults(f"{self.name}: {topic}"):
            if hasattr(message, "rotation"):
                return motion(self._path, topic, message)
            own = {key: value.split(",") for key, value in _pairs(message)}
            R = numbers(self._path, topic, own["rotation"], 9).reshape(3, 3).T
            return rigid(self._path, topic, R, numbers(self._path, topic, own["translation"], 3))


def _pairs(message: Any) -> list[tuple[str, str]]:
    """Keys and values of a KeyValue message, or of text `key=value;key=value`."""
    if hasattr(message, "key"):
        return [(str(message.key), str(message.value))]
    text = str(getattr(message, "data", ""))
    return [
        (key.strip(), value.strip()) for key, equals, value in (p.partition("=") for p in text.split(";")) if equals
    ]


def _dictionary(bag: Bag, topic: str) -> dict[str, str]:
    out: dict[str, str] = {}
    for message in bag.all(topic) if topic in bag.types else ():
        out.update(_pairs(message))
    return out


def _option(bag: Bag, sensor: str, names: tuple[str, ...]) -> float | None:
    """Metres for each unit of depth; single precision is rounded to what was meant."""
    for name in names:
        topic = f"{sensor}/option/{name}/value"
        message = bag.first(topic) if topic in bag.types else None
        if message is not None:
            with bag_faults(f"{bag.name}: {topic}"):
                value = float(f"{float(message.data):.6g}")
            return value if 1e-6 <= value <= 1 else None
    return None

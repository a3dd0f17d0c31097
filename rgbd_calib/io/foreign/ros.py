"""Cameras of ROS 1 bags, ROS 2 bags and MCAP files: images, camera_info, and static transforms between their frames.

Depth of 16 bits is in millimetres and 32FC1 in metres (REP 118). Depth whose messages have the colour images' frame_id, or
whose topic says so, is registered; otherwise /tf_static between the two frames is T_color_depth.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.calibrations.ros_ import lens_of_info
from rgbd_calib.io.foreign.bag import COMPRESSED, IMAGE, INFO, Bag, bag_faults, matrices, motion, open_bag, stamp_us
from rgbd_calib.io.foreign.ros_images import picture_of
from rgbd_calib.io.foreign.ros_topics import CameraTopics, find_topics
from rgbd_calib.io.foreign.source import Kind, Source, SourceCamera, SourceImage, Stamps, Wanted

DEPTH_SCALE = 0.001
_MAX_FRAMES = 1000


class RosBag(Source):
    """The cameras of one bag; times are those of the messages' headers.

    Parameters
    ----------
    topics
        By camera; empty: found by name and type.
    """

    def __init__(self, path: Path, topics: Mapping[str, CameraTopics] | None = None) -> None:
        self.name = str(path)
        self._path = path
        self._stamps: dict[str, dict[Kind, list[int]]] = {}
        with open_bag(path) as bag:
            self._topics = dict(topics) if topics else find_topics(path, bag.types)
            self._check(bag.types)
            self._streams = {topic: (camera, kind) for camera, own in self._topics.items() for kind, topic in own}
            remarks: list[str] = []
            transforms = _static_transforms(path, bag)
            self.cameras = {c: self._camera(bag, c, own, transforms, remarks) for c, own in self._topics.items()}
            left = [t for t, kind in bag.types.items() if kind in (IMAGE, COMPRESSED) and t not in self._streams]
            if left:
                remarks.append(f"{path}: image topics that are not used: {', '.join(left)[:500]}")
        self.remarks = tuple(remarks)

    def stamps(self) -> Mapping[str, Stamps]:
        if not self._stamps:
            found: dict[str, dict[Kind, list[int]]] = {c: {k: [] for k, _ in own} for c, own in self._topics.items()}
            with open_bag(self._path) as bag:
                for topic, _, read in bag.messages(self._streams.__contains__):
                    camera, kind = self._streams[topic]
                    with bag_faults(self.name):
                        found[camera][kind].append(stamp_us(read()))
            self._stamps = found
        return self._stamps

    def pictures(self, wanted: Wanted) -> Iterator[SourceImage]:
        counts: dict[tuple[str, Kind], int] = defaultdict(int)
        with open_bag(self._path) as bag:
            for topic, _, read in bag.messages(self._streams.__contains__):
                camera, kind = self._streams[topic]
                index = counts[camera, kind]
                counts[camera, kind] += 1
                if wanted(camera, kind, index):
                    where = f"{self.name}: {topic}"
                    message = read()
                    with bag_faults(where):
                        yield SourceImage(camera, kind, index, picture_of(message, kind, where))

    def _check(self, types: Mapping[str, str]) -> None:
        for camera, own in self._topics.items():
            for _, topic in own:
                if types.get(topic) not in (IMAGE, COMPRESSED):
                    images = ", ".join(t for t, kind in types.items() if kind in (IMAGE, COMPRESSED)) or "none"
                    raise ConfigError(
                        f"{self.name}: {camera}: {topic} is no image topic of it; there are {images[:500]}. Correct --topics"
                    )

    def _camera(
        self, bag: Bag, camera: str, topics: CameraTopics, transforms: _Transforms, remarks: list[str]
    ) -> SourceCamera:
        color = _info(self._path, bag, camera, topics.color, remarks)
        if topics.depth is None:
            return SourceCamera(color)
        frames = [_frame_id(bag, topic) for topic in (topics.color, topics.depth)]
        registered: bool | None = None
        if topics.says_registered:
            registered = True
        elif all(frames):
            registered = frames[0] == frames[1]
        if registered is not False:
            return SourceCamera(color, None, DEPTH_SCALE, registered)
        T = transforms.between(frames[0], frames[1])
        if T is None:
            T = _extrinsics(self._path, bag, topics)
        if T is None:
            remarks.append(f"{self._path}: {camera}: no transform from {frames[1]} to {frames[0]} in it")
        depth = _info(self._path, bag, camera, topics.depth, remarks)
        return SourceCamera(color, None, DEPTH_SCALE, False, depth, T)


class _Transforms:
    """Static transforms between named frames."""

    def __init__(self) -> None:
        self._to: dict[str, dict[str, FloatArray]] = defaultdict(dict)

    def add(self, parent: str, child: str, T_parent_child: FloatArray) -> None:
        if len(self._to) < _MAX_FRAMES:
            self._to[child][parent] = T_parent_child
            self._to[parent][child] = se3.inverse(T_parent_child)

    def between(self, target: str, source: str) -> FloatArray | None:
        """T_target_source along the tree; None where the two are not joined."""
        found: dict[str, FloatArray] = {source: np.eye(4)}
        waiting = [source]
        while waiting:
            frame = waiting.pop()
            for other, T_other_frame in self._to.get(frame, {}).items():
                if other not in found:
                    found[other] = T_other_frame @ found[frame]
                    waiting.append(other)
        return found.get(target)


def _static_transforms(path: Path, bag: Bag) -> _Transforms:
    transforms = _Transforms()
    for topic in (t for t in bag.types if t.strip("/") == "tf_static"):
        for message in bag.all(topic):
            with bag_faults(f"{path}: {topic}"):
                for own in message.transforms:
                    parent, child = own.header.frame_id.strip("/"), own.child_frame_id.strip("/")
                    transforms.add(parent, child, motion(path, f"{topic}: {child}", own.transform))
    return transforms


def _extrinsics(path: Path, bag: Bag, topics: CameraTopics) -> FloatArray | None:
    """The depth_to_color of realsense2_camera: rotation column by column, metres."""
    topic = next((t for t in bag.types if t.endswith("extrinsics/depth_to_color")), None)
    message = None if topic is None else bag.first(topic)
    if message is None:
        return None
    with bag_faults(f"{path}: {topic}"):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.array(message.rotation, float).reshape(3, 3).T, message.translation
    return T


def _frame_id(bag: Bag, topic: str) -> str:
    message = bag.first(topic)
    with bag_faults(f"{bag.name}: {topic}"):
        return "" if message is None else str(message.header.frame_id).strip("/")


def _info(path: Path, bag: Bag, camera: str, topic: str, remarks: list[str]) -> Intrinsics | None:
    """The lens of an image topic, of the camera_info beside it."""
    base = topic.removesuffix("/compressed").removesuffix("/compressedDepth")
    beside = [base.rpartition("/")[0] + "/camera_info", base + "/camera_info"]
    name = next((t for t in beside if bag.types.get(t) == INFO), None)
    message: Any = None if name is None else bag.first(name)
    if message is None:
        return None
    with bag_faults(f"{path}: {name}"):
        K, D = matrices(message)
        if not K[0] > 0:
            remarks.append(f"{path}: {name}: no camera matrix in it (fx is 0): not used")
            return None
        size = (int(message.width), int(message.height))
        return lens_of_info(path, f"{camera}: {name}", size, K, str(message.distortion_model), D)

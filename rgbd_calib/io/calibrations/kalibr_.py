"""Kalibr's camchain.yaml: pinhole cameras with radtan or equidistant distortion, each posed against the one before.

https://github.com/ethz-asl/kalibr/wiki/yaml-formats: T_cn_cnm1 takes points of camera n - 1 to camera n. The world is the
first camera.
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.io.calibrations.common import (
    Document,
    FoundCalibration,
    FoundCamera,
    Numbers,
    lens,
    numbers,
    rigid_of_matrix,
)
from rgbd_calib.io.tables import short

_STREAMS = ("color", "colour", "rgb", "image", "depth", "ir", "infra")


def recognises(document: Document) -> bool:
    first = document.tree.get("cam0")
    return isinstance(first, dict) and "camera_model" in first and "intrinsics" in first


def read(document: Document) -> FoundCalibration:
    path, tree = document.path, document.tree
    T_world_cam = np.eye(4)
    cameras, topics, left, posed = [], [], [], True
    for n, key in enumerate(k for k in tree if k.startswith("cam") and isinstance(tree[k], dict)):
        own = tree[key]
        kind, distortion = own.get("camera_model"), own.get("distortion_model", "none")
        if kind != "pinhole" or distortion not in ("radtan", "equidistant", "none"):
            raise ConfigError(
                f"{path}: {key}: {short(kind)}-{short(distortion)} seen; pinhole-radtan or pinhole-equi needed. Calibrate it "
                "with Kalibr's --models pinhole-radtan"
            )
        fx, fy, cx, cy = numbers(path, f"{key}.intrinsics", own.get("intrinsics"), 4)
        coefficients: Numbers = (
            () if distortion == "none" else numbers(path, f"{key}.distortion_coeffs", own.get("distortion_coeffs"), 4)
        )
        size = document.need_size(own.get("resolution"))
        found = lens(path, key, size, (fx, fy), (cx, cy), coefficients, distortion == "equidistant")
        if n and "T_cn_cnm1" in own:
            T_world_cam = T_world_cam @ se3.inverse(rigid_of_matrix(path, f"{key}.T_cn_cnm1", own["T_cn_cnm1"]))
        elif n:
            posed = False
        cameras.append(FoundCamera(found, T_world_cam.copy()))
        topics.append(str(own.get("rostopic", "")))
        left += [f"{key}.{k}" for k in own if k in ("timeshift_cam_imu", "T_cam_imu")]
    names = _names(topics) or [f"cam{n}" for n in range(len(cameras))]
    notes = [f"cam{n} is called {name}, after its topic" for n, name in enumerate(names) if name != f"cam{n}"]
    if left:
        notes.append(f"not used: {', '.join(left)}")
    if len(cameras) < 2 or not posed:
        cameras = [FoundCamera(camera.intrinsics) for camera in cameras]
    return FoundCalibration("Kalibr camchain", dict(zip(names, cameras, strict=True)), tuple(notes))


def _names(topics: list[str]) -> list[str]:
    """What stands before the stream in topics as /C1/color/image_raw; empty where that names no camera apart."""
    names = []
    for topic in topics:
        parts = topic.strip("/").split("/")
        first = next((i for i, part in enumerate(parts) if any(word in part for word in _STREAMS)), len(parts) - 1)
        names.append("_".join(parts[:first]))
    return names if all(names) and len(set(names)) == len(names) else []

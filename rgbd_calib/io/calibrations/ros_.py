"""ROS camera_info: YAML of `camera_calibration` and of `rostopic echo`, alone or in a folder beside static transforms.

distortion_model is plumb_bob (4 or 5 coefficients), rational_polynomial (8, or up to 14), or equidistant (OpenCV's
fisheye, 4). https://docs.ros.org/en/api/sensor_msgs/html/msg/CameraInfo.html
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.calibrations.common import (
    Document,
    FoundCalibration,
    FoundCamera,
    lens_of_matrix,
    load_document,
    matrix,
    needed,
    numbers,
    rigid_of_quaternion,
)
from rgbd_calib.io.reading import read_bytes
from rgbd_calib.io.tables import short

FISHEYE = ("equidistant", "fisheye", "kannala_brandt")
_OPENCV = ("plumb_bob", "rational_polynomial", "brown conrady", "brown_conrady", "none", "")
_STATIC = re.compile(r'args="([^"]+)"')


def recognises(document: Document) -> bool:
    tree = document.tree
    if document.path.is_dir():
        return bool(_infos(document.path))
    return ("image_width" in tree and "camera_matrix" in tree and "distortion_model" in tree) or (
        "distortion_model" in tree and ("K" in tree or "k" in tree)
    )


def read(document: Document) -> FoundCalibration:
    if not document.path.is_dir():
        name, found = _camera(document)
        return FoundCalibration("ROS camera_info", {name: FoundCamera(found)})
    cameras = dict(_camera(own) for own in _infos(document.path))
    poses, notes = _static_transforms(document.path, list(cameras))
    return FoundCalibration("ROS camera_info", {n: FoundCamera(own, poses.get(n)) for n, own in cameras.items()}, notes)


def lens_of_info(
    path: Path, camera: str, size: tuple[int, int], K: Any, model: str, D: Any, key: str = "distortion_coefficients"
) -> Intrinsics:
    """The lens that the fields of a CameraInfo describe.

    Raises
    ------
    ConfigError
        A distortion model that this program does not have.
    """
    name = str(model).lower().strip()
    distortion = numbers(path, f"{camera}: {key}", D if D is not None else []).tolist()
    if name not in (*_OPENCV, *FISHEYE):
        raise ConfigError(
            f"{path}: {camera}: distortion_model {short(model)} seen; plumb_bob, rational_polynomial or equidistant needed. "
            "Calibrate it with one of these, or with `rgbd-calib intrinsics`"
        )
    if name == "none":
        distortion = []
    if name == "plumb_bob" and len(distortion) > 5:
        raise ConfigError(
            f"{path}: {camera}: {len(distortion)} coefficients seen, plumb_bob has 5. Correct distortion_model"
        )
    if name in FISHEYE and len(distortion) > 4 and not any(distortion[4:]):
        distortion = distortion[:4]
    K_ = matrix(path, f"{camera}: camera_matrix", K, 3, 3)
    return lens_of_matrix(path, camera, size, K_, distortion, name in FISHEYE)


def _infos(folder: Path) -> list[Document]:
    found = []
    for path in sorted(p for p in folder.iterdir() if p.suffix.lower() in (".yaml", ".yml")):
        try:
            document = load_document(path)
        except ConfigError:
            continue
        if recognises(document):
            found.append(document)
    return found


def _camera(document: Document) -> tuple[str, Intrinsics]:
    tree, path = document.tree, document.path
    name = str(tree.get("camera_name") or path.stem)
    size = (tree.get("image_width", tree.get("width")), tree.get("image_height", tree.get("height")))
    K = tree.get("camera_matrix", tree.get("K", tree.get("k")))
    model = str(tree.get("distortion_model", ""))
    D = [] if model == "none" else needed(path, name, tree, "distortion_coefficients", "D", "d")
    own = document.need_size(None if None in size else size)
    return name, lens_of_info(path, name, own, K, model, D)


def _static_transforms(folder: Path, cameras: list[str]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """T_world_color by camera from launch files: `args="x y z qx qy qz qw PARENT CHILD"`."""
    poses, notes = {}, []
    for path in sorted(folder.glob("*.launch")):
        text = read_bytes(path, 1 << 20).decode("utf-8", "replace")
        for words in (args.split() for args in _STATIC.findall(text)):
            if len(words) != 9:
                continue
            frame = words[8]
            camera = next(
                (c for c in sorted(cameras, key=len, reverse=True) if frame == f"{c}_color_optical_frame"), None
            )
            if camera is None:
                notes.append(f"{path}: the transform to {frame} is not used: no camera_info of it")
                continue
            x, y, z, qx, qy, qz, qw = numbers(path, frame, words[:7], 7)
            poses[camera] = rigid_of_quaternion(path, frame, (qw, qx, qy, qz), (x, y, z))
    return poses, tuple(notes)

"""The calibration of a Kinect v2 by iai_kinect2, a folder of OpenCV YAML: calib_color, calib_ir, calib_pose.

calib_pose takes points of the infrared camera, which is the depth camera, to the colour camera. calib_depth holds a shift of
depth. https://github.com/code-iai/iai_kinect2/tree/master/kinect2_calibration
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.calibrations.common import (
    Document,
    FoundCalibration,
    FoundCamera,
    Size,
    lens_of_matrix,
    load_document,
    matrix,
    numbers,
    rigid,
)
from rgbd_calib.types import DepthCamera

COLOR_SIZE, DEPTH_SIZE = (1920, 1080), (512, 424)


def recognises(document: Document) -> bool:
    path = document.path
    return path.is_dir() and any((path / name).is_file() for name in ("calib_color.yaml", "calib_ir.yaml"))


def read(document: Document) -> FoundCalibration:
    folder, notes = document.path, []
    color = _lens(folder / "calib_color.yaml", COLOR_SIZE)
    infrared = _lens(folder / "calib_ir.yaml", DEPTH_SIZE)
    depth = None
    pose = folder / "calib_pose.yaml"
    if infrared is not None and pose.is_file():
        tree = load_document(pose).tree
        R = matrix(pose, "rotation", tree.get("rotation"), 3, 3)
        depth = DepthCamera(
            infrared, rigid(pose, "rotation", R, numbers(pose, "translation", tree.get("translation"), 3))
        )
    elif infrared is not None:
        notes.append(f"{folder / 'calib_ir.yaml'} is not used: there is no calib_pose.yaml beside it")
    shift = folder / "calib_depth.yaml"
    if shift.is_file():
        notes.append(f"{shift} is not used: depth is calibrated anew")
    if color is None:
        raise ConfigError(f"{folder}: calib_color.yaml is missing. Copy it there")
    return FoundCalibration(
        "iai_kinect2 calibration", {folder.name or "kinect2": FoundCamera(color, depth=depth)}, tuple(notes)
    )


def _lens(path: Path, size: Size) -> Intrinsics | None:
    if not path.is_file():
        return None
    tree = load_document(path).tree
    K = matrix(path, "cameraMatrix", tree.get("cameraMatrix"), 3, 3)
    D = numbers(path, "distortionCoefficients", tree.get("distortionCoefficients", np.zeros(5)))
    return lens_of_matrix(path, path.stem, size, K, D)

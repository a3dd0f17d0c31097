"""The calibration of an Azure Kinect or Orbbec Femto, JSON as it is attached to recordings (`k4a_device_get_raw_calibration`).

It holds for the whole sensor: parameters in units of the image, (0, 0) at the corner of the top left pixel. Each mode bins
and crops; the tables are those of the Azure Kinect SDK (transformation/mode_specific_calibration.c). Rt takes points of the
device to the camera, metres; k1 to k6, p1, p2 are those of OpenCV's rational lens.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.calibrations.common import Document, FoundCalibration, FoundCamera, Size, lens, numbers, rigid
from rgbd_calib.io.tables import short
from rgbd_calib.types import DepthCamera

COLOR_MODES: dict[Size, tuple[Size, Size]] = {
    (1280, 720): ((1280, 960), (0, 120)),
    (1920, 1080): ((1920, 1440), (0, 180)),
    (2560, 1440): ((2560, 1920), (0, 240)),
    (2048, 1536): ((2048, 1536), (0, 0)),
    (3840, 2160): ((3840, 2880), (0, 360)),
    (4096, 3072): ((4096, 3072), (0, 0)),
    (1280, 960): ((1280, 960), (0, 0)),
}
"""Of the images: the binned size of the sensor's 4:3 image, and where the crop begins."""
DEPTH_MODES: dict[Size, tuple[Size, Size]] = {
    (320, 288): ((512, 512), (96, 90)),
    (640, 576): ((1024, 1024), (192, 180)),
    (512, 512): ((512, 512), (0, 0)),
    (1024, 1024): ((1024, 1024), (0, 0)),
}
_COLOR, _DEPTH = "CALIBRATION_CameraLocationPV0", "CALIBRATION_CameraLocationD0"
_BROWN_CONRADY = "CALIBRATION_LensDistortionModelBrownConrady"


def recognises(document: Document) -> bool:
    return "CalibrationInformation" in document.tree


def read(document: Document) -> FoundCalibration:
    """The lenses at the size that the user says, depth at 640x576."""
    size = document.need_size()
    depth_size = (640, 576)
    camera = read_device(document.path, document.tree, size, depth_size)
    notes = (f"depth at {depth_size[0]}x{depth_size[1]} px (NFOV unbinned) is assumed",)
    return FoundCalibration("Azure Kinect calibration", {document.stem: camera}, notes)


def read_device(path: Path, tree: Any, color_size: Size | None, depth_size: Size | None) -> FoundCamera:
    """Colour and depth camera at the sizes of their images; None where there are none.

    Raises
    ------
    ConfigError
        Not such a calibration, another lens model, or a size that no mode has.
    """
    try:
        cameras = {str(own["Location"]): own for own in tree["CalibrationInformation"]["Cameras"]}
    except (KeyError, TypeError):
        raise ConfigError(f"{path}: CalibrationInformation.Cameras is missing. Is it the right file?") from None
    color = None if color_size is None else _lens(path, cameras, _COLOR, color_size, COLOR_MODES)
    if depth_size is None:
        return FoundCamera(color)
    depth = _lens(path, cameras, _DEPTH, depth_size, DEPTH_MODES)
    T_color_depth = _pose(path, cameras, _COLOR) @ se3.inverse(_pose(path, cameras, _DEPTH))
    return FoundCamera(color, depth=DepthCamera(depth, T_color_depth))


def _lens(
    path: Path, cameras: dict[str, Any], location: str, size: Size, modes: dict[Size, tuple[Size, Size]]
) -> Intrinsics:
    own = _camera(path, cameras, location)
    intrinsics = own.get("Intrinsics")
    if not isinstance(intrinsics, dict) or intrinsics.get("ModelType") != _BROWN_CONRADY:
        seen = intrinsics.get("ModelType") if isinstance(intrinsics, dict) else intrinsics
        raise ConfigError(f"{path}: {location}: lens model {short(seen)} seen, {_BROWN_CONRADY} needed")
    if size not in modes:
        known = ", ".join(f"{w}x{h}" for w, h in modes)
        raise ConfigError(f"{path}: {location}: {size[0]}x{size[1]} px seen, one of {known} needed")
    values = numbers(path, f"{location}: ModelParameters", intrinsics.get("ModelParameters"), (14, 15))
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = values[:14]
    width, height = numbers(path, location, [own.get("SensorWidth"), own.get("SensorHeight")], 2)
    if location == _COLOR and width * 9 == height * 16:  # of early devices: 16:9 of the 4:3 sensor
        cy, fy = (cy * 2304 + 384) / 3072, fy * 2304 / 3072
    (binned_w, binned_h), (left, top) = modes[size]
    focal = (fx * binned_w, fy * binned_h)
    centre = (cx * binned_w - left - 0.5, cy * binned_h - top - 0.5)
    return lens(path, location, size, focal, centre, (k1, k2, p1, p2, k3, k4, k5, k6))


def _pose(path: Path, cameras: dict[str, Any], location: str) -> FloatArray:
    own = _camera(path, cameras, location).get("Rt")
    if not isinstance(own, dict):
        raise ConfigError(f"{path}: {location}: Rt is missing. Is it the right file?")
    R = numbers(path, f"{location}: Rotation", own.get("Rotation"), 9).reshape(3, 3)
    return rigid(path, location, R, np.array(numbers(path, f"{location}: Translation", own.get("Translation"), 3)))


def _camera(path: Path, cameras: dict[str, Any], location: str) -> dict[str, Any]:
    own = cameras.get(location)
    if not isinstance(own, dict):
        raise ConfigError(f"{path}: no camera {location} in it; {', '.join(cameras)[:200]} seen. Is it the right file?")
    return own

"""Calibrations of other programs: one module a format, each with ``recognises(document)`` and ``read(document)``."""

from __future__ import annotations

import importlib
from pathlib import Path

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.calibrations.common import Document, FoundCalibration, FoundCamera, Size, load_document

__all__ = ["FORMATS", "FoundCalibration", "FoundCamera", "read_calibration", "recognise"]

FORMATS = {
    "iai": "iai_kinect2 calibration folder",
    "own": "this program's rig.yaml, or its JSON",
    "azure": "Azure Kinect and Orbbec Femto calibration JSON",
    "mrcal": "mrcal .cameramodel (OPENCV models), or a folder of them",
    "kalibr": "Kalibr camchain YAML",
    "ros": "ROS camera_info YAML, or a folder of them",
    "nerfstudio": "nerfstudio transforms.json",
    "open3d": "Open3D trajectory or intrinsics JSON",
    "caliscope": "caliscope or Anipose TOML",
    "realsense": "JSON of RealSense intrinsics",
    "colmap": "COLMAP model, text or binary",
    "matrix": "text with a camera matrix (intrinsic*.txt, K.txt)",
    "opencv": "OpenCV YAML, XML or JSON",
}
"""In the order in which a file is offered to them: what is told apart by a key of its own comes first."""


def read_calibration(path: Path, size: Size | None = None) -> FoundCalibration:
    """A calibration in any of the formats.

    Raises
    ------
    ConfigError
        None of these, or a file that cannot be read, or one with a lens that this program does not have.
    """
    if not path.exists():
        raise ConfigError(f"{path}: no such file or folder")
    document = load_document(path, size)
    name = recognise(document)
    if name is None:
        raise ConfigError(f"{path}: no calibration that is known; {'; '.join(FORMATS.values())} are. Convert it to one")
    found: FoundCalibration = importlib.import_module(f"rgbd_calib.io.calibrations.{name}_").read(document)
    if not found.cameras:
        raise ConfigError(f"{path}: no camera in it ({found.what}). Is it complete?")
    return found


def recognise(document: Document) -> str | None:
    """The name of the format, or None."""
    for name in FORMATS:
        if importlib.import_module(f"rgbd_calib.io.calibrations.{name}_").recognises(document):
            return name
    return None

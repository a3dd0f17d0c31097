"""Open3D: PinholeCameraTrajectory, PinholeCameraIntrinsic, and the intrinsics that its recorders write beside the images.

Matrices stand column by column; `extrinsic` takes the world's points to the camera. Pixels as here; no distortion.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.calibrations.common import (
    Document,
    FoundCalibration,
    FoundCamera,
    lens_of_matrix,
    numbers,
    rigid_of_matrix,
)


def recognises(document: Document) -> bool:
    tree = document.tree
    return str(tree.get("class_name", "")).startswith("PinholeCamera") or (
        "intrinsic_matrix" in tree and "width" in tree
    )


def read(document: Document) -> FoundCalibration:
    path, tree = document.path, document.tree
    if "parameters" not in tree:
        own = tree.get("intrinsic", tree)
        return FoundCalibration("Open3D intrinsics", {path.stem: FoundCamera(_lens(path, path.stem, document, own))})
    if not isinstance(tree["parameters"], list):
        raise ConfigError(f"{path}: parameters: a list of cameras needed. Is it the right file?")
    cameras = {}
    for i, own in enumerate(tree["parameters"], 1):
        if not isinstance(own, dict) or "intrinsic" not in own or "extrinsic" not in own:
            raise ConfigError(f"{path}: parameters[{i - 1}]: intrinsic and extrinsic are needed. Is it complete?")
        T_color_world = rigid_of_matrix(path, f"C{i}", numbers(path, f"C{i}", own["extrinsic"], 16).reshape(4, 4).T)
        cameras[f"C{i}"] = FoundCamera(_lens(path, f"C{i}", document, own["intrinsic"]), se3.inverse(T_color_world))
    notes = (f"Open3D knows no names of cameras: they are called {', '.join(cameras)}, in the file's order",)
    return FoundCalibration("Open3D trajectory", cameras, notes)


def _lens(path: Path, name: str, document: Document, own: Any) -> Intrinsics:
    if not isinstance(own, dict):
        raise ConfigError(f"{path}: {name}: width, height and intrinsic_matrix are needed. Is it the right file?")
    K = numbers(path, f"{name}: intrinsic_matrix", own.get("intrinsic_matrix"), 9).reshape(3, 3).T
    size = document.need_size((own["width"], own["height"]) if "width" in own and "height" in own else None)
    return lens_of_matrix(path, name, size, K)

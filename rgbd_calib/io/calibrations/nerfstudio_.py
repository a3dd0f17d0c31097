"""nerfstudio's transforms.json: camera-to-world in OpenGL axes (x right, y up, z back), intrinsics for all or for each frame.

The centre of the top left pixel is (0.5, 0.5) there. https://docs.nerf.studio/quickstart/data_conventions.html
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.calibrations.common import Document, FoundCalibration, FoundCamera, lens, numbers, rigid_of_matrix
from rgbd_calib.io.tables import short

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_KEYS = ("fl_x", "fl_y", "cx", "cy")


def recognises(document: Document) -> bool:
    frames = document.tree.get("frames")
    return isinstance(frames, list) and bool(frames) and isinstance(frames[0], dict) and "transform_matrix" in frames[0]


def read(document: Document) -> FoundCalibration:
    path, tree = document.path, document.tree
    frames = [frame for frame in tree["frames"] if isinstance(frame, dict)]
    shared = {k: v for k, v in tree.items() if k != "frames"}
    names = _names([str(frame.get("file_path", "")) for frame in frames])
    lenses = [_lens(path, name, document, shared | frame) for name, frame in zip(names, frames, strict=True)]
    unit = "poses have the unit that the file has; metres are assumed"
    if len(frames) > 1 and all(own == lenses[0] for own in lenses):  # one camera that was carried around
        return FoundCalibration(
            "nerfstudio transforms",
            {document.stem: FoundCamera(lenses[0])},
            (f"one camera in {len(frames)} places: its places are not used",),
        )
    cameras = {
        name: FoundCamera(
            own, rigid_of_matrix(path, f"{name}.transform_matrix", frame.get("transform_matrix")) @ _OPENGL
        )
        for name, own, frame in zip(names, lenses, frames, strict=True)
    }
    return FoundCalibration("nerfstudio transforms", cameras, (unit,))


def _names(files: list[str]) -> list[str]:
    """The camera's name of file_path: its folder in CAM/color/0.png, its stem in CAM.png."""
    parts = [PurePosixPath(file).parts for file in files]
    for names in ([p[0] if len(p) > 1 else "" for p in parts], [PurePosixPath(file).stem for file in files]):
        if all(names) and len(set(names)) == len(names):
            return names
    return [f"frame{i}" for i in range(len(files))]


def _lens(path: Path, name: str, document: Document, own: dict[str, Any]) -> Intrinsics:
    missing = [key for key in _KEYS if key not in own]
    if missing:
        raise ConfigError(f"{path}: {name}: {', '.join(missing)} missing; {', '.join(_KEYS)} are needed")
    fx, fy, cx, cy = numbers(path, name, [own[key] for key in _KEYS], 4)
    size = document.need_size((own["w"], own["h"]) if "w" in own and "h" in own else None)
    kind = str(own.get("camera_model", "OPENCV")).upper()
    fisheye = kind == "OPENCV_FISHEYE"
    if kind not in ("OPENCV", "OPENCV_FISHEYE", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE"):
        raise ConfigError(f"{path}: {name}: camera_model {short(kind)} seen; OPENCV or OPENCV_FISHEYE needed")
    order = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    distortion = numbers(path, f"{name}: distortion", [own.get(key, 0.0) for key in order])
    if not fisheye and own.get("k4"):
        raise ConfigError(f"{path}: {name}: k4 of model {kind} seen, which has no place in OpenCV's lens. Take it out")
    return lens(path, name, size, (fx, fy), (cx - 0.5, cy - 0.5), distortion, fisheye)

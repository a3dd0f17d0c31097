"""OpenCV's FileStorage (YAML, XML, JSON) as people fill it: camera matrices and distortion under many names.

Camera matrices are found by name (camera_matrix, cameraMatrix, K, M1, ...); what is left of the name (a number, left,
right, rgb) joins them with distortion, and names the camera. R and T of two cameras are those of stereoCalibrate: they take
points of the first to the second. `cameras`, a list with `name`, is what `rgbd-calib export --to opencv` writes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.io.calibrations.common import (
    Document,
    FoundCalibration,
    FoundCamera,
    lens_of_matrix,
    matrix,
    needed,
    numbers,
    rigid_of_matrix,
    rigid_of_vectors,
)

_MATRIX = ("cameramatrix", "intrinsicmatrix", "cammatrix", "intrinsics", "intrinsic", "mtx", "k", "m")
_DISTORTION = (
    "distortioncoefficients",
    "distortioncoeffs",
    "distcoeffs",
    "distcoef",
    "distortion",
    "distortions",
    "dist",
    "d",
)
_ROTATION, _TRANSLATION = ("r", "rotation", "rotationmatrix"), ("t", "translation", "translationvector")
_WIDTH, _HEIGHT, _SIZE = ("imagewidth", "width"), ("imageheight", "height"), ("imagesize", "size", "resolution")


def recognises(document: Document) -> bool:
    tree = document.tree
    return bool(_matrices(tree)) or (isinstance(tree.get("cameras"), list) and "reference" in tree)


def read(document: Document) -> FoundCalibration:
    if isinstance(document.tree.get("cameras"), list):
        return _own_export(document)
    path, tree, notes = document.path, document.tree, []
    matrices = _matrices(tree)
    distortion = _by_rest(tree, _DISTORTION)
    size = _size(tree)
    fisheye = any("fisheye" in key.lower() and str(value) in ("1", "True", "true") for key, value in tree.items())
    cameras = {}
    for rest, key in matrices.items():
        K = matrix(path, key, tree[key], 3, 3)
        D = numbers(path, distortion[rest], tree[distortion[rest]]) if rest in distortion else np.zeros(0)
        if rest not in distortion:
            notes.append(f"{key}: no distortion beside it, none is assumed")
        name = rest if rest and not rest.isdigit() else f"C{rest or 1}"
        if len(matrices) == 1:
            name = str(tree.get("camera_name") or document.stem)
        cameras[name] = FoundCamera(lens_of_matrix(path, name, document.need_size(size), K, D, fisheye))
    R, t = _one(tree, _ROTATION), _one(tree, _TRANSLATION)
    if len(cameras) == 2 and R and t:
        first, second = cameras
        T_second_first = rigid_of_vectors(path, R, _data(tree[R]), _data(tree[t]))
        cameras[first] = FoundCamera(cameras[first].intrinsics, np.eye(4))
        cameras[second] = FoundCamera(cameras[second].intrinsics, se3.inverse(T_second_first))
        notes.append(f"{R}, {t} are taken as stereoCalibrate's, from {first} to {second}, in metres")
    return FoundCalibration("OpenCV calibration", cameras, tuple(notes))


def _own_export(document: Document) -> FoundCalibration:
    path, cameras = document.path, {}
    for i, own in enumerate(document.tree["cameras"]):
        if not isinstance(own, Mapping) or not {"name", "camera_matrix"} <= set(own):
            raise ConfigError(f"{path}: cameras[{i}]: name and camera_matrix are needed. Is it complete?")
        name = str(own["name"])
        K = matrix(path, f"{name}.camera_matrix", own["camera_matrix"], 3, 3)
        D = numbers(path, f"{name}.distortion_coefficients", needed(path, name, own, "distortion_coefficients"))
        found = lens_of_matrix(path, name, document.need_size(_size(own)), K, D, bool(_flag(own.get("fisheye"))))
        T = rigid_of_matrix(path, f"{name}.T_world_color", own["T_world_color"]) if "T_world_color" in own else None
        cameras[name] = FoundCamera(found, T)
    return FoundCalibration("OpenCV calibration", cameras)


def _flag(value: Any) -> bool:
    return str(value) in ("1", "True", "true")


def _matrices(tree: Mapping[str, Any]) -> dict[str, str]:
    """Keys of camera matrices by what is left of their names."""
    found = _by_rest(tree, _MATRIX)
    return {rest: key for rest, key in found.items() if _count(tree[key]) == 9}


def _count(value: Any) -> int:
    try:
        return int(np.array(_data(value), dtype=float).size)
    except (TypeError, ValueError, OverflowError):
        return 0


def _data(value: Any) -> Any:
    return value["data"] if isinstance(value, Mapping) and "data" in value else value


def _by_rest(tree: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, str]:
    out: dict[str, str] = {}
    longest = max(map(len, names))  # words have a letter at least
    for key in tree:
        words = [w for w in re.split(r"[^A-Za-z\d]+|(?<=[a-z])(?=[A-Z\d])|(?<=[A-Z])(?=\d)", key) if w]
        for i in range(len(words)):
            for j in range(min(len(words), i + longest), i, -1):
                if "".join(words[i:j]).lower() in names:
                    rest = "_".join(w.lower() for w in (*words[:i], *words[j:]) if w.lower() not in ("camera", "cam"))
                    out.setdefault(rest, key)
                    break
            else:
                continue
            break
    return out


def _one(tree: Mapping[str, Any], names: tuple[str, ...]) -> str:
    return next((key for key in tree if re.sub(r"[^a-z]", "", key.lower()) in names), "")


def _size(tree: Mapping[str, Any]) -> Any:
    """(width, height) as the file says it, or None."""
    plain = {re.sub(r"[^a-z]", "", key.lower()): value for key, value in tree.items()}
    for width, height in ((w, h) for w in _WIDTH for h in _HEIGHT):
        if width in plain and height in plain:
            return plain[width], plain[height]
    return next((plain[key] for key in _SIZE if key in plain and _count(plain[key]) == 2), None)

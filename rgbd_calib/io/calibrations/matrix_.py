"""A camera matrix as bare text: 3x3 or 4x4 numbers, or `fx fy cx cy`, in a file that is named after it (ScanNet's
intrinsic_color.txt, 3DMatch's camera-intrinsics.txt, K.txt). No distortion, and no size of the images."""

from __future__ import annotations

import re

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.calibrations.common import Document, FoundCalibration, FoundCamera, lens_of_matrix, numbers
from rgbd_calib.io.tables import short

_NAME = re.compile(r"(.*intrinsics?.*|k|cam_?k|camera|calib)\.txt", re.IGNORECASE)


def recognises(document: Document) -> bool:
    if not _NAME.fullmatch(document.path.name) or len(document.text) > 10_000:
        return False
    try:
        return len(_values(document.text)) in (4, 9, 16)
    except ValueError:
        return False


def read(document: Document) -> FoundCalibration:
    path, name = document.path, document.stem
    values = numbers(path, "camera matrix", _values(document.text), (4, 9, 16))
    if len(values) == 4:
        fx, fy, cx, cy = values
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    else:
        n = 3 if len(values) == 9 else 4
        K = values.reshape(n, n)[:3, :3]
    if not (K[0, 0] > 0 and K[1, 1] > 0):
        raise ConfigError(f"{path}: {short(K.tolist())} seen, a camera matrix needed. Is it the right file?")
    return FoundCalibration("camera matrix", {name: FoundCamera(lens_of_matrix(path, name, document.need_size(), K))})


def _values(text: str) -> list[float]:
    lines = [line.partition("#")[0] for line in text.splitlines()]
    return [float(word) for word in re.split(r"[\s,;\[\]]+", " ".join(lines)) if word]

"""mrcal's .cameramodel, or a folder of them.

A model is a Python literal with `lensmodel`, `intrinsics`, `imagersize` and `rt_cam_ref` (or `extrinsics`). OPENCV4, 5, 8 and
12 are OpenCV's models with the same meaning of pixels. rt_cam_ref is a rotation vector and a translation that take points of
the reference to the camera. https://mrcal.secretsauce.net/cameramodels.html
"""

from __future__ import annotations

import ast
import re
import warnings
from pathlib import Path

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.io.calibrations.common import (
    Document,
    FoundCalibration,
    FoundCamera,
    lens,
    load_document,
    numbers,
    rigid_of_vectors,
)
from rgbd_calib.io.tables import short

_COEFFICIENTS = {
    "LENSMODEL_PINHOLE": 0,
    "LENSMODEL_OPENCV4": 4,
    "LENSMODEL_OPENCV5": 5,
    "LENSMODEL_OPENCV8": 8,
    "LENSMODEL_OPENCV12": 12,
}
_OPTIMIZATION = re.compile(r"'optimization_inputs'\s*:\s*\n?\s*b'(?:[^'\\]|\\.)*'\s*,?", re.DOTALL)


def recognises(document: Document) -> bool:
    if document.path.is_dir():
        return bool(_models(document.path))
    return "lensmodel" in document.text[:100_000] and "LENSMODEL_" in document.text


def read(document: Document) -> FoundCalibration:
    folder = document.path.is_dir()
    models = [load_document(path, document.size) for path in _models(document.path)] if folder else [document]
    return FoundCalibration("mrcal cameramodel", {own.stem: _camera(own) for own in models})


def _models(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("*.cameramodel") if path.is_file())


def _camera(document: Document) -> FoundCamera:
    path = document.path
    lines = [line for line in document.text.splitlines() if not line.lstrip().startswith("#")]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the parser, on standard error
            # a solution's whole input may stand in it, as text of bytes; nothing of it is needed
            model = ast.literal_eval(_OPTIMIZATION.sub("", "\n".join(lines)))
    except (ValueError, SyntaxError, MemoryError, RecursionError) as error:
        why = " ".join(str(error).split())[:200]
        raise ConfigError(f"{path}: cannot be read as a cameramodel ({why}). Is it complete? Copy it again") from None
    if not isinstance(model, dict):
        raise ConfigError(f"{path}: {short(model)} seen, a cameramodel {{...}} needed. Is it the right file?")
    name = model.get("lensmodel")
    if not isinstance(name, str) or name not in _COEFFICIENTS:
        raise ConfigError(
            f"{path}: lensmodel {short(name)} seen; {', '.join(_COEFFICIENTS)} needed. Convert it with "
            "`mrcal-convert-lensmodel LENSMODEL_OPENCV8`"
        )
    fx, fy, cx, cy, *distortion = numbers(path, "intrinsics", model.get("intrinsics"), 4 + _COEFFICIENTS[name])
    size = document.need_size(model.get("imagersize"))
    own = lens(path, path.stem, size, (fx, fy), (cx, cy), distortion)
    pose = model.get("rt_cam_ref", model.get("extrinsics"))
    if pose is None:
        return FoundCamera(own)
    rt = numbers(path, "rt_cam_ref", pose, 6)
    return FoundCamera(own, se3.inverse(rigid_of_vectors(path, "rt_cam_ref", rt[:3], rt[3:])))

"""This program's own: a rig file, a part of one, or the same as JSON (`rgbd-calib export --to json`)."""

from __future__ import annotations

import numpy as np

from rgbd_calib.io.calibrations.common import Document, FoundCalibration, FoundCamera
from rgbd_calib.io.schema_base import parse
from rgbd_calib.io.schemas import RigModel


def recognises(document: Document) -> bool:
    return document.tree.get("format") == "rgbd-calib/rig"


def read(document: Document) -> FoundCalibration:
    model = parse(RigModel, dict(document.tree), document.path)
    cameras = {
        name: FoundCamera(
            own.intrinsics.value() if own.intrinsics else None,
            None if own.T_world_color is None else np.array(own.T_world_color),
            own.depth.value() if own.depth else None,
        )
        for name, own in model.cameras.items()
    }
    notes = [f"{n}: depth errors are not used" for n, own in model.cameras.items() if own.depth_bias or own.depth_field]
    return FoundCalibration("rig", cameras, tuple(notes))

"""Kalibr's camchain.yaml: pinhole cameras with radtan or equidistant distortion, each posed against the one before.

radtan is k1, k2, p1, p2: there is no k3; equidistant is OpenCV's fisheye. The chain starts at the reference camera; it has no world.
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.io.exports.common import Export, FormatLens, Options, bias_note, with_carried_lenses
from rgbd_calib.io.files import dump_yaml
from rgbd_calib.types import Rig

LENSES = (FormatLens("opencv", 4, "radtan"), FormatLens("kannala_brandt", 4, "equidistant"))


def export(rig: Rig, options: Options) -> Export:
    """One YAML file; raises ConfigError where a lens is like none of Kalibr's."""
    rig, refitted = with_carried_lenses(rig, "Kalibr", LENSES, options.max_px)
    order = sorted(rig.cameras, key=lambda name: name != rig.reference)
    chain = {}
    for n, name in enumerate(order):
        camera = rig.cameras[name]
        lens = camera.intrinsics
        entry = {
            "camera_model": "pinhole",
            "intrinsics": [lens.fx, lens.fy, lens.cx, lens.cy],
            "distortion_model": "equidistant" if lens.model == "kannala_brandt" else "radtan",
            "distortion_coeffs": list(lens.distortion[:4]),
            "resolution": [lens.width, lens.height],
            "rostopic": f"/{name}/color/image_raw",
            "cam_overlaps": [other for other in range(len(order)) if other != n],
        }
        if n:
            T_world_before = rig.cameras[order[n - 1]].T_world_color
            entry["T_cn_cnm1"] = (se3.inverse(camera.T_world_color) @ T_world_before).tolist()
        chain[f"cam{n}"] = entry
    names = ", ".join(f"cam{n} is {name}" for n, name in enumerate(order))
    notes: tuple[str, ...] = (f"Kalibr numbers the cameras: {names}", "cam_overlaps lists all other cameras")
    if not np.array_equal(rig.cameras[order[0]].T_world_color, np.eye(4)):
        notes += (f"Kalibr has no world: poses are relative to {order[0]}",)
    return Export({"": f"# {names}\n{dump_yaml(chain)}"}, refitted + notes + bias_note(rig, "Kalibr"))

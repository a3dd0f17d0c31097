"""OpenCV FileStorage: YAML, XML or JSON by the file's suffix. Same lens model, same pixel convention."""

from __future__ import annotations

import numpy as np

from rgbd_calib.io.exports.common import Export, Options
from rgbd_calib.types import Rig


def export(rig: Rig, options: Options) -> Export:
    """One FileStorage: `reference`, and `cameras`, a sequence of maps with `name`, `camera_matrix` and so on.

    Names stand in values, since OpenCV's keys must begin with a letter.
    """
    import cv2

    store = cv2.FileStorage(options.suffix or ".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    store.write("reference", rig.reference)
    store.startWriteStruct("cameras", cv2.FILE_NODE_SEQ)
    for name, camera in rig.cameras.items():
        lens = camera.intrinsics
        store.startWriteStruct("", cv2.FILE_NODE_MAP)
        store.write("name", name)
        store.write("image_width", lens.width)
        store.write("image_height", lens.height)
        store.write("camera_matrix", lens.K)
        store.write("distortion_coefficients", np.array([lens.distortion]))
        if lens.model == "kannala_brandt":
            store.write("fisheye", 1)
        store.write("T_world_color", camera.T_world_color)
        if camera.depth_bias is not None:
            store.write("depth_bias_coefficients", np.array([camera.depth_bias.coefficients]))
            store.write("depth_bias_min_m", camera.depth_bias.min_m)
            store.write("depth_bias_max_m", camera.depth_bias.max_m)
        store.endWriteStruct()
    store.endWriteStruct()
    return Export({"": store.releaseAndGetString()})

"""nerfstudio's transforms.json: camera-to-world in OpenGL axes (x right, y up, z back), intrinsics for each frame.

The centre of the top left pixel is (0.5, 0.5) there, so cx and cy are larger by 0.5. Its OPENCV model has k1, k2, k3,
p1, p2 with OpenCV's meaning. Images are not copied; `file_path` is what --image-name says.
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.io.exports.common import Export, Options, bias_note
from rgbd_calib.io.plain import to_json
from rgbd_calib.types import Rig

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""T_color_opengl: the same camera with y up and z back."""


def export(rig: Rig, options: Options) -> Export:
    """One JSON file."""
    image_names = options.image_names(rig)
    frames = []
    for name, camera in rig.cameras.items():
        lens = camera.intrinsics
        k1, k2, p1, p2, k3 = lens.distortion
        frames.append(
            {
                "file_path": image_names[name],
                "w": lens.width,
                "h": lens.height,
                "fl_x": lens.fx,
                "fl_y": lens.fy,
                "cx": lens.cx + 0.5,
                "cy": lens.cy + 0.5,
                "k1": k1,
                "k2": k2,
                "k3": k3,
                "p1": p1,
                "p2": p2,
                "transform_matrix": (camera.T_world_color @ OPENGL).tolist(),
            }
        )
    notes = (f"file_path is {frames[0]['file_path']} and so on; change it with --image-name",)
    text = to_json({"camera_model": "OPENCV", "frames": frames}, indent=1, ensure_ascii=False) + "\n"
    return Export({"": text}, notes + bias_note(rig, "nerfstudio"))

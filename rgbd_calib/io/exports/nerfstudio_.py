"""nerfstudio's transforms.json: camera-to-world in OpenGL axes (x right, y up, z back), intrinsics for each frame.

The centre of the top left pixel is (0.5, 0.5) there, so cx and cy are larger by 0.5. Its OPENCV model has k1, k2, k3,
p1, p2 with OpenCV's meaning, OPENCV_FISHEYE k1 to k4. Images are not copied; `file_path` is what --image-name says.
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.exports.common import (
    FISHEYE,
    Export,
    FormatLens,
    Options,
    bias_note,
    coefficients,
    with_carried_lenses,
)
from rgbd_calib.io.plain import to_json
from rgbd_calib.types import Rig

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""T_color_opengl: the same camera with y up and z back."""
LENSES = (FormatLens("opencv", 5, "OPENCV"), FormatLens("kannala_brandt", 4, "OPENCV_FISHEYE"))


def export(rig: Rig, options: Options) -> Export:
    """One JSON file."""
    rig, refitted = with_carried_lenses(rig, "nerfstudio", LENSES, options.max_px)
    models = {camera.intrinsics.model for camera in rig.cameras.values()}
    if len(models) > 1:
        raise ConfigError(
            "nerfstudio has one lens model for all cameras; fisheye and others seen. Export with --undistorted"
        )
    order = FISHEYE if models == {"kannala_brandt"} else ("k1", "k2", "k3", "p1", "p2")
    image_names = options.image_names(rig)
    frames = []
    for name, camera in rig.cameras.items():
        lens = camera.intrinsics
        k = coefficients(lens)
        frames.append(
            {
                "file_path": image_names[name],
                "w": lens.width,
                "h": lens.height,
                "fl_x": lens.fx,
                "fl_y": lens.fy,
                "cx": lens.cx + 0.5,
                "cy": lens.cy + 0.5,
                **{name: k.get(name, 0.0) for name in order},
                "transform_matrix": (camera.T_world_color @ OPENGL).tolist(),
            }
        )
    notes = (f"file_path is {frames[0]['file_path']} and so on; change it with --image-name",)
    model = "OPENCV_FISHEYE" if models == {"kannala_brandt"} else "OPENCV"
    text = to_json({"camera_model": model, "frames": frames}, indent=1, ensure_ascii=False) + "\n"
    return Export({"": text}, refitted + notes + bias_note(rig, "nerfstudio"))

"""Open3D's PinholeCameraTrajectory: K and T_color_world of each camera, in the rig's order. No lens distortion.

Open3D's pixel (0, 0) is the centre of the top left pixel, as here. Matrices are column by column.
"""

from __future__ import annotations

from rgbd_calib.geometry import se3
from rgbd_calib.io.exports.common import Export, FormatLens, Options, bias_note, with_carried_lenses
from rgbd_calib.io.plain import to_json
from rgbd_calib.types import Rig


def export(rig: Rig, options: Options) -> Export:
    """One JSON file; raises ConfigError where a camera is no pinhole."""
    rig, refitted = with_carried_lenses(rig, "Open3D", (FormatLens("opencv", 0, "a pinhole"),), options.max_px)
    parameters = [
        {
            "class_name": "PinholeCameraParameters",
            "extrinsic": se3.inverse(camera.T_world_color).T.ravel().tolist(),
            "intrinsic": {
                "width": camera.intrinsics.width,
                "height": camera.intrinsics.height,
                "intrinsic_matrix": camera.intrinsics.K.T.ravel().tolist(),
            },
            "version_major": 1,
            "version_minor": 0,
        }
        for camera in rig.cameras.values()
    ]
    head = {"class_name": "PinholeCameraTrajectory", "version_major": 1, "version_minor": 0}
    notes = (
        *refitted,
        f"Open3D knows no camera names; the order is {', '.join(rig.cameras)}",
        *bias_note(rig, "Open3D"),
    )
    return Export({"": to_json(head | {"parameters": parameters}, indent=1) + "\n"}, notes)

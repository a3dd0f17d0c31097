"""ROS: a camera_info file for each camera (its lens complete) and the poses as static transforms.

Frames are `world` and, for each camera, `NAME_color_optical_frame` (REP 103: x right, y down, z forward), so a static
transform is T_world_color as it is. Pixel (0, 0) is the centre of the top left pixel, as here.
"""

from __future__ import annotations

import re

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.exports.common import Export, Options, bias_note
from rgbd_calib.io.files import dump_yaml
from rgbd_calib.types import Rig, RigCamera

_LAUNCH_PY = '''"""Static transforms from the world to the colour cameras of a rig, for ROS 2."""

from launch import LaunchDescription
from launch_ros.actions import Node

TRANSFORMS = {{
{lines}
}}


def generate_launch_description():
    keys = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    return LaunchDescription(
        [
            Node(
                package="tf2_ros",
                executable="static_transform_publisher",
                name="static_transform_" + frame,
                arguments=[word for pair in zip(keys, values) for word in pair]
                + ["--frame-id", "world", "--child-frame-id", frame],
            )
            for frame, values in TRANSFORMS.items()
        ]
    )
'''


def export(rig: Rig, options: Options) -> Export:
    """A folder of NAME.yaml for each camera, rig.launch.py (ROS 2) and rig.launch (ROS 1)."""
    for name in rig.cameras:
        if not re.fullmatch(r"[A-Za-z0-9_]+", name):
            raise ConfigError(
                f"{name}: camera names of ROS are letters, digits and underscores. Rename the camera in the rig file"
            )
    files = {f"{name}.yaml": dump_yaml(_camera_info(name, camera.intrinsics)) for name, camera in rig.cameras.items()}
    frames = {f"{name}_color_optical_frame": _values(camera) for name, camera in rig.cameras.items()}
    lines = [f'    "{frame}": [{", ".join(repr(v) for v in values)}],' for frame, values in frames.items()]
    files["rig.launch.py"] = _LAUNCH_PY.format(lines="\n".join(lines))
    nodes = [
        f'  <node pkg="tf2_ros" type="static_transform_publisher" name="static_transform_{frame}"\n'
        f'        args="{" ".join(values)} world {frame}" />'
        for frame, values in frames.items()
    ]
    files["rig.launch"] = "\n".join(["<launch>", *nodes, "</launch>", ""])
    return Export(files, bias_note(rig, "ROS"))


def _values(camera: RigCamera) -> list[str]:
    w, x, y, z = so3.quaternion_wxyz(camera.T_world_color[:3, :3])
    return [repr(float(value)) for value in (*camera.T_world_color[:3, 3], x, y, z, w)]


def _camera_info(name: str, lens: Intrinsics) -> dict[str, object]:
    def matrix(rows: int, cols: int, data: list[float]) -> dict[str, object]:
        return {"rows": rows, "cols": cols, "data": data}

    fisheye = lens.model == "kannala_brandt"
    model = "equidistant" if fisheye else "plumb_bob" if len(lens.distortion) <= 5 else "rational_polynomial"
    P = np.hstack([lens.K, np.zeros((3, 1))])
    return {
        "image_width": lens.width,
        "image_height": lens.height,
        "camera_name": name,
        "camera_matrix": matrix(3, 3, lens.K.ravel().tolist()),
        "distortion_model": model,
        "distortion_coefficients": matrix(1, len(lens.distortion), list(lens.distortion)),
        "rectification_matrix": matrix(3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        "projection_matrix": matrix(3, 4, P.ravel().tolist()),
    }

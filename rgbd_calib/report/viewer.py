"""A rig and its clouds in Rerun: cameras with their frusta and images, clouds by camera, one world.

Rerun's pinholes have no distortion: frusta and images are drawn with K alone, clouds with the whole lens model.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.report.splat import camera_color
from rgbd_calib.types import Rig

if TYPE_CHECKING:
    from rgbd_calib.geometry.so3 import FloatArray

TIMELINE = "frame"


def rerun() -> Any:
    """The module `rerun`, or a ConfigError that says how to install it."""
    try:
        import rerun as rr
    except ImportError as error:
        raise ConfigError(
            f"view: the viewer Rerun is not installed ({error}); `pip install rgbd-calib[view]` (about 160 MB). "
            "Without it, `rgbd-calib fuse --image` makes pictures, and any program shows its .ply"
        ) from error
    return rr


def log_rig(stream: Any, rig: Rig, frustum_m: float = 0.15) -> None:
    """Log every camera: pose, frustum with its image plane at `frustum_m` metres, name, colour."""
    rr = rerun()
    stream.log("world", rr.ViewCoordinates.RDF, static=True)
    for i, (name, camera) in enumerate(rig.cameras.items()):
        lens, T = camera.intrinsics, camera.T_world_color
        path = _path(name)
        stream.log(path, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]), static=True)
        pinhole = rr.Pinhole(
            image_from_camera=lens.K,
            resolution=[lens.width, lens.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=frustum_m,
            color=camera_color(i),
        )
        stream.log([*path, "image"], pinhole, static=True)
        stream.log([*path, "name"], rr.Points3D([[0, 0, 0]], colors=[camera_color(i)], labels=[name]), static=True)


def log_frame(
    stream: Any,
    number: int,
    clouds: Mapping[str, tuple[FloatArray, np.ndarray]],
    images: Mapping[str, Path],
) -> None:
    """Log one instant: points (n, 3), metres, in the world, with colours (n, 3), and colour images, PNG or JPEG files."""
    rr = rerun()
    stream.set_time(TIMELINE, sequence=number)
    for camera, (points_m, colors) in clouds.items():
        stream.log(["world", "clouds", camera], rr.Points3D(points_m.astype(np.float32), colors=colors, radii=-1.0))
    for camera, file in images.items():
        stream.log([*_path(camera), "image"], rr.EncodedImage(path=file))


def _path(camera: str) -> list[str]:
    return ["world", "cameras", camera]  # as parts: names may hold any character

"""One instant of a recording as one cloud: every camera's depth, its bias removed, in the world (paper, figure 11)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.files import whole_file
from rgbd_calib.io.recording import Recording
from rgbd_calib.pipeline.rig_inputs import check_depth_geometry, check_frame, common_cameras
from rgbd_calib.types import Rig, RigCamera

GREY = np.uint8(128)
"""Of points of which no colour is known."""
MARGIN_PX = 4
"""Depth that is registered to colour is not quite, and may reach a little beyond its image."""


@dataclass(frozen=True)
class FuseParams:
    """What of a depth image is used."""

    max_depth_m: float = np.inf
    """Depth beyond this is left out."""
    within_range: bool = False
    """Depth outside the range of the data that the rig's depth bias rests on is left out."""
    jump: float = 0.02
    """A pixel that differs from one of its 8 neighbours by more than this share of its depth is left out: it lies on
    an edge, where sensors put points between the two surfaces. 2 % is a slope of 85 degrees at f = 525 px, and more
    than 6 sigma of a structured-light sensor (1.6e-3 z^2) below 2 m."""


@dataclass(frozen=True)
class Cloud:
    """What one camera adds to the fused cloud."""

    camera: str
    points_m: FloatArray
    """(n, 3), metres, in the world."""
    colors: np.ndarray
    """(n, 3), uint8, R G B, from the colour image."""
    dropped: dict[str, int]
    """Pixels with a measurement that were left out, by reason."""
    outside: int
    """Points outside the range of the depth bias's data: corrected less surely."""


def fullest_frame(recording: Recording, cameras: tuple[str, ...]) -> str:
    """The frame that most of these cameras have depth in, the first where several do.

    Raises
    ------
    CalibrationError
        No camera has any depth.
    """
    counts = {frame: sum(recording.has_depth(c, frame) for c in cameras) for frame in recording.frames}
    best = max(recording.frames, key=lambda frame: counts[frame])
    if counts[best] == 0:
        raise CalibrationError(
            f"{recording.path}: cameras {', '.join(cameras)} have no depth images; a cloud is made of depth. "
            "Record with depth"
        )
    return best


@one_blas_thread
def clouds_of(recording: Recording, rig: Rig, frame: str, params: FuseParams = FuseParams()) -> tuple[Cloud, ...]:
    """One cloud for each camera that has depth in this frame, in the recording's order.

    Raises
    ------
    ConfigError
        No such frame, or the rig is not of this recording.
    CalibrationError
        No camera of the rig has depth in this frame.
    """
    cameras = common_cameras(recording, rig)
    check_frame(recording, frame)
    clouds = tuple(_cloud(recording, rig, name, frame, params) for name in cameras if recording.has_depth(name, frame))
    if not clouds:
        best = fullest_frame(recording, cameras)
        raise CalibrationError(
            f"{recording.path}: frame {frame}: none of {', '.join(cameras)} has depth in it; at least one is needed. "
            f"Frame {best} has it"
        )
    return clouds


def on_jump(depth_m: FloatArray, share: float) -> np.ndarray:
    """Pixels (h, w), bool, that differ from one of their 8 neighbours by more than `share` of their depth."""
    import cv2

    z = np.nan_to_num(depth_m).astype(np.float32)
    far = cv2.dilate(z, np.ones((3, 3), np.uint8))
    near = -cv2.dilate(np.where(z > 0, -z, -np.inf).astype(np.float32), np.ones((3, 3), np.uint8))
    return np.asarray((z > 0) & (np.maximum(far - z, z - near) > share * z))


def left_out(camera: RigCamera, depth_m: FloatArray, p_color: FloatArray, params: FuseParams) -> dict[str, np.ndarray]:
    """Pixels (h, w), bool, with a measurement of which no point is made, by reason.

    `p_color` (h, w, 3), metres, is where they are in the colour camera's frame.
    """
    jump = on_jump(depth_m, params.jump)
    measured = np.isfinite(depth_m) & ~jump
    far = measured & (p_color[..., 2] > params.max_depth_m)
    return {
        "edge": jump,
        "too far": far,
        "outside the range of the bias's data": _outside(camera, depth_m) & measured & ~far & params.within_range,
        "beyond the lens model": measured & ~np.isfinite(p_color).all(axis=-1),
        "behind the camera once corrected": measured & (p_color[..., 2] <= 0),
    }


def _outside(camera: RigCamera, depth_m: FloatArray) -> np.ndarray:
    """Pixels (h, w), bool, outside the range of the data of the depth's bias."""
    bias = camera.depth_bias
    return np.zeros(depth_m.shape, bool) if bias is None else bias.outside(depth_m)


def write_ply(path: Path, points_m: FloatArray, colors: np.ndarray) -> None:
    """Write points (n, 3), metres, with colours (n, 3), uint8, as binary PLY."""
    import open3d as o3d

    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor.from_numpy(np.ascontiguousarray(points_m, np.float32)))
    cloud.point.colors = o3d.core.Tensor.from_numpy(np.ascontiguousarray(colors, np.uint8))
    with whole_file(path) as temporary:
        written = o3d.t.io.write_point_cloud(temporary, cloud)
        if not written or not _is_whole(temporary, len(points_m)):  # Open3D does not notice that the disk is full
            raise ConfigError(f"{path}: could not be written (disk full?). Free space, or choose another disk")


def _is_whole(path: Path, points: int) -> bool:
    """True where the PLY file is as long as its header and points of three floats and three bytes."""
    end = b"end_header\n"
    with path.open("rb") as stream:
        head = stream.read(2000)
    return end in head and path.stat().st_size == head.index(end) + len(end) + 15 * points


def _cloud(recording: Recording, rig: Rig, name: str, frame: str, params: FuseParams) -> Cloud:
    camera = rig.cameras[name]
    check_depth_geometry(recording, name, camera)
    depth_m = recording.depth_own_m(name, frame)
    p_color = camera.depth_image.points(depth_m)
    dropped = left_out(camera, depth_m, p_color, params)
    kept = np.isfinite(depth_m) & ~np.any(list(dropped.values()), axis=0)
    outside = _outside(camera, depth_m) & kept
    p_color = p_color[kept]
    if frame in recording.color_files[name]:
        at = np.rint(np.clip(np.nan_to_num(camera.intrinsics.project(p_color), nan=-1e6), -1e6, 1e6)).astype(int)
        size = np.array([camera.intrinsics.width, camera.intrinsics.height])
        u, v = np.clip(at, 0, size - 1).T
        shown = np.all((at > -MARGIN_PX) & (at < size - 1 + MARGIN_PX), axis=1)  # depth may see more than colour does
        colors = np.where(shown[:, None], recording.color(name, frame)[v, u, ::-1], GREY)
    else:
        colors = np.full((len(p_color), 3), GREY)
    counts = {why: int(np.count_nonzero(pixels)) for why, pixels in dropped.items()}
    return Cloud(name, se3.transform(camera.T_world_color, p_color), colors, counts, int(np.count_nonzero(outside)))

"""A recording for programs that know nothing of this one: depth without bias, its error over the image and misregistration, and,
if asked, without distortion."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.depth_image import seen_by
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io import tables
from rgbd_calib.io.depth_files import NO_MEASUREMENT
from rgbd_calib.io.exports.common import without_lens
from rgbd_calib.io.images import MAX_BYTES
from rgbd_calib.io.reading import read_bytes
from rgbd_calib.io.recording import DepthGeometry, Recording, save_color, save_depth, write_dataset
from rgbd_calib.io.rig import write_rig
from rgbd_calib.pipeline.detection import Progress, silent
from rgbd_calib.pipeline.rig_inputs import check_depth_geometry, common_cameras
from rgbd_calib.types import Rig, RigCamera

_TABLES = ("timestamps.csv", "distances.csv")
_COARSEST_M = 0.001
"""Unit of the 16-bit depth that is written, where that of the recording (of floating-point depth, say) is coarser."""


@dataclass(frozen=True)
class Corrected:
    """What was written for one camera."""

    color_images: int
    depth_images: int
    lost_pixels: int
    """Measured depth pixels that do not fit 16 bits, or are not positive, once corrected; they became 0."""
    outside_pixels: int
    """Measured depth pixels outside the range of the bias's data: corrected less surely, or left out."""
    measured_pixels: int


@dataclass(frozen=True)
class UndistortMap:
    """Where in the distorted image each pixel of the undistorted one is found."""

    u_px: FloatArray
    """(h, w)."""
    v_px: FloatArray
    valid: np.ndarray
    """(h, w), bool: inside the image, where the lens model can be inverted."""


def undistort_map(lens: Intrinsics) -> UndistortMap:
    """The map to a pinhole with the same K."""
    u, v = np.meshgrid(np.arange(lens.width, dtype=float), np.arange(lens.height, dtype=float))
    directions = np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones_like(u)], axis=-1)
    source = lens.project(directions)
    inside = (np.abs(source - [(lens.width - 1) / 2, (lens.height - 1) / 2]) <= [lens.width / 2, lens.height / 2]).all(
        -1
    )
    with np.errstate(invalid="ignore"):
        unique = np.abs(lens.rays(source) - directions).max(axis=-1) < 1e-6
    return UndistortMap(source[..., 0], source[..., 1], inside & unique)


Geometry = Literal["color", "depth"]


def correct_depth(
    depth_raw: np.ndarray, scale: float, camera: RigCamera, geometry: Geometry = "color", within_range: bool = False
) -> tuple[np.ndarray, int, int]:
    """Depth (h, w), uint16 in units of `scale`, as the sensor would have reported it without errors, in the colour camera's
    geometry, or pixel by pixel in the depth camera's own; and how many pixels were lost and outside.

    Returns
    -------
    corrected, lost, outside
        Rounded to the unit. Lost: not in 1 ... 65535 any more, set to 0. Outside: the range of the data, set to 0 if
        `within_range`.
    """
    bias, measured, z_m = camera.depth_bias, depth_raw > 0, depth_raw * scale
    outside = measured & bias.outside(z_m) if bias is not None else np.zeros_like(measured)
    if within_range:
        depth_raw = np.where(outside, 0, depth_raw).astype(depth_raw.dtype)
        measured = measured & ~outside
    if geometry == "depth" and (bias is not None or camera.depth_field is not None):
        points_m = camera.depth_image.points(np.where(measured, z_m, np.nan))
        true_m = se3.transform(se3.inverse(camera.depth_sensor.camera.T_color_depth), points_m)[..., 2]
    elif geometry == "color" and (camera.depth_field is not None or camera.depth_camera is not None):
        lens, points_m = camera.intrinsics, camera.depth_image.points(np.where(measured, z_m, np.nan))
        true_m = seen_by(points_m, lens, max(1.0, lens.fx / camera.depth_sensor.camera.intrinsics.fx))
    elif geometry == "color" and bias is not None:
        true_m = np.where(measured, bias.correct(z_m), np.nan)
    else:
        return depth_raw, 0, int(np.count_nonzero(outside))
    units = np.rint(np.nan_to_num(true_m) / scale)
    fits = (units >= 1) & (units <= np.iinfo(np.uint16).max)
    lost = int(np.count_nonzero(np.isfinite(true_m) & ~fits))
    return np.where(fits, units, 0).astype(np.uint16), lost, int(np.count_nonzero(outside))


@one_blas_thread
def correct(
    recording: Recording,
    rig: Rig,
    out: Path,
    undistort: bool = False,
    geometry: Geometry = "color",
    within_range: bool = False,
    jobs: int | None = None,
    progress: Progress = silent,
) -> dict[str, Corrected]:
    """Write the corrected recording, and the rig that belongs to it, into the folder `out`; say what was done by camera.

    Depth gets the geometry of the colour image, or keeps its own, whose calibration then stands in dataset.yaml and in the rig.
    Colour images are copied as they are unless `undistort`. Cameras that the rig does not have are left out.

    Raises
    ------
    ConfigError
        A damaged image, a rig of other cameras, a recording that is corrected already.
    """
    cameras = common_cameras(recording, rig)
    for c in cameras:
        if recording.depth_files[c]:
            check_depth_geometry(recording, c, rig.cameras[c])
    fitting = _rig_of_corrected(rig, cameras, undistort, geometry)
    infos = {
        c: replace(
            recording.cameras[c],
            intrinsics=fitting.cameras[c].intrinsics,
            depth_scale=min(recording.cameras[c].depth_scale, _COARSEST_M),
            invalid=(),
            depth=_geometry_of(fitting.cameras[c]),
            float_unit_m=1.0,
        )
        for c in cameras
    }
    maps = {c: undistort_map(rig.cameras[c].intrinsics) if undistort else None for c in cameras}

    def do_color(camera: str, frame: str) -> tuple[int, int, int]:
        source, to = recording.color_files[camera][frame], maps[camera]
        if to is None:
            target = out / camera / "color" / f"{frame}{source.suffix}"
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(read_bytes(source, MAX_BYTES))
        else:
            save_color(out, camera, frame, _bilinear(recording.color(camera, frame), to))
        return 0, 0, 0

    def do_depth(camera: str, frame: str) -> tuple[int, int, int]:
        info, to = infos[camera], maps[camera]
        units = np.nan_to_num(np.rint(recording.depth_own_m(camera, frame) / info.depth_scale))
        depth_raw = np.where(units < NO_MEASUREMENT, units, 0).astype(np.uint16)
        corrected, lost, outside = correct_depth(
            depth_raw, info.depth_scale, rig.cameras[camera], geometry, within_range
        )
        save_depth(out, camera, frame, corrected if to is None else _nearest(corrected, to))
        return lost, outside, int(np.count_nonzero(depth_raw))

    work: list[tuple[Callable[[str, str], tuple[int, int, int]], str, str]] = []
    for camera in cameras:
        work += [(do_color, camera, frame) for frame in recording.color_files[camera]]
        work += [(do_depth, camera, frame) for frame in recording.depth_files[camera]]
    pool = ThreadPoolExecutor(jobs or os.cpu_count())
    try:
        results = list(progress(pool.map(lambda job: job[0](job[1], job[2]), work), len(work), "Correcting"))
    finally:
        pool.shutdown(cancel_futures=True)

    for camera in cameras:
        for table in _TABLES:
            if (recording.path / camera / table).exists():
                (out / camera / table).write_bytes(read_bytes(recording.path / camera / table, tables.MAX_BYTES))
    extra = recording.extra | {"corrected": {"depth_bias": True, "undistorted": undistort, "geometry": geometry}}
    write_dataset(out, infos, recording.board, extra)
    write_rig(out / "rig.yaml", fitting)
    summary = {}
    for camera in cameras:
        own = [result for result, job in zip(results, work, strict=True) if job[1] == camera]
        lost, outside, measured = (sum(column) for column in zip(*own, strict=True))
        counts = len(recording.color_files[camera]), len(recording.depth_files[camera])
        summary[camera] = Corrected(*counts, lost, outside, measured)
    return summary


def _geometry_of(camera: RigCamera) -> DepthGeometry | None:
    """Of depth in the depth camera's own geometry."""
    own = camera.depth_camera
    if own is None:
        return None
    return DepthGeometry(own.intrinsics.width, own.intrinsics.height, own.intrinsics, None, own.T_color_depth)


def _rig_of_corrected(rig: Rig, cameras: tuple[str, ...], undistort: bool, geometry: Geometry) -> Rig:
    kept = {camera: replace(rig.cameras[camera], depth_bias=None, depth_field=None) for camera in cameras}
    if geometry == "color":
        kept = {name: replace(own, depth_camera=None) for name, own in kept.items()}
    reference = rig.reference if rig.reference in kept else cameras[0]
    fitting = replace(rig, reference=reference, cameras=kept)
    return without_lens(fitting) if undistort else fitting


def _bilinear(image: np.ndarray, to: UndistortMap) -> np.ndarray:
    import cv2

    out = cv2.remap(
        image, to.u_px.astype(np.float32), to.v_px.astype(np.float32), cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE
    )
    out[~to.valid] = 0
    return out


def _nearest(depth_raw: np.ndarray, to: UndistortMap) -> np.ndarray:
    height, width = depth_raw.shape
    v = np.clip(np.rint(np.where(to.valid, to.v_px, 0)), 0, height - 1).astype(int)
    u = np.clip(np.rint(np.where(to.valid, to.u_px, 0)), 0, width - 1).astype(int)
    return np.where(to.valid, depth_raw[v, u], 0).astype(np.uint16)

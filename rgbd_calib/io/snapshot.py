"""Snapshots: what a recording of a still scene shows, camera by camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.layout import Files, Kind
from rgbd_calib.io.recording import Recording, save_color, save_depth, write_dataset
from rgbd_calib.types import CameraSnapshot

MOST_FRAMES = 30
"""Depth images of a camera that are used, spread over the recording."""
_NEAR_SIGMAS, _NEAR_SHARE = 4.0, 0.02
"""A reading belongs to the mean within both: 2 % is more than one step of a quantised disparity (47 mm at 4 m)."""
_MAD = 1.4826
_ROWS = 16
"""Of all depth images together that fit into a processor's own memory."""
FRAME = "000000"
KEPT_UNIT_M = 0.00025
"""Unit of kept depth: up to 16 m, its rounding below the noise of any mean."""


def read_snapshot(recording: Recording, camera: str) -> CameraSnapshot | None:
    """One camera's part of a snapshot; None where the camera has no depth, or no colour."""
    color, depth_m = recording.color_files[camera], depth_of(recording, camera)
    if depth_m is None or not color:
        return None
    frames = min(len(recording.depth_files[camera]), MOST_FRAMES)
    return CameraSnapshot(camera, recording.color(camera, next(iter(color))), depth_m, frames)


def depth_of(recording: Recording, camera: str, frames: Sequence[str] | None = None) -> FloatArray | None:
    """Depth (h, w) of a still scene, metres as measured: the mean of these frames, None: of up to `MOST_FRAMES` of all.

    The readings near their median count: sensors that quantise depth send one of two steps, and the mean of many readings
    lies between. None where the camera has none of the frames.
    """
    have = recording.depth_files[camera]
    chosen = [*have] if frames is None else [frame for frame in frames if frame in have]
    if not chosen:
        return None
    if len(chosen) > MOST_FRAMES:
        chosen = [chosen[i] for i in np.linspace(0, len(chosen) - 1, MOST_FRAMES).round().astype(int)]
    return averaged(np.stack([recording.depth_own_m(camera, frame).astype(np.float32) for frame in chosen]))


def newest_frames(recording: Recording, frames: int) -> Recording:
    """The recording's newest image in colour and newest `frames` in depth of each camera, by name."""
    listed: dict[Kind, Files] = {
        "color": {name: _last(files, 1) for name, files in recording.color_files.items()},
        "depth": {name: _last(files, frames) for name, files in recording.depth_files.items()},
        "ir": {name: {} for name in recording.cameras},
    }
    return replace(recording, listed=listed)


def _last(files: Mapping[str, Path], count: int) -> dict[str, Path]:
    return {frame: files[frame] for frame in sorted(files)[-count:]}


def kept_beside(rig_path: Path) -> Path:
    """Folder of the snapshot that is kept with a rig file: rig.snapshot beside rig.yaml."""
    return rig_path.with_name(f"{rig_path.stem}.snapshot")


def keep_snapshot(folder: Path, recording: Recording) -> int:
    """Write what a comparison needs of a snapshot, as a recording of one frame, into an existing empty folder.

    Returns
    -------
    Its size in bytes.

    Raises
    ------
    CalibrationError
        No camera has colour and depth.
    """
    infos = {}
    for name, info in recording.cameras.items():
        snapshot = read_snapshot(recording, name)
        if snapshot is None:
            continue
        infos[name] = replace(
            info, depth_scale=KEPT_UNIT_M, float_unit_m=1.0, depth_stated=True, intrinsics=None, invalid=()
        )
        raw = np.nan_to_num(snapshot.depth_m / KEPT_UNIT_M)
        save_depth(folder, name, FRAME, np.where(raw < 65535, np.rint(raw), 0).astype(np.uint16))
        save_color(folder, name, FRAME, snapshot.color)
    if not infos:
        raise CalibrationError(
            f"{recording.path}: no camera has colour and depth images; a snapshot needs both. Record the empty scene with "
            "`rgbd-calib capture OUT --snapshot`"
        )
    write_dataset(folder, infos, None)
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def averaged(stack_m: np.ndarray) -> np.ndarray:
    """Mean (h, w), float64, of depth images (n, h, w), metres, NaN where there is none.

    A pixel that fewer than half of the images measured is NaN.
    """
    if len(stack_m) == 1:
        return stack_m[0].astype(float)
    # some rows at a time, the readings of a pixel side by side: half the time of the whole stack
    parts = [_mean_of_near(stack_m[:, v : v + _ROWS]) for v in range(0, stack_m.shape[1], _ROWS)]
    return np.concatenate(parts)


def _mean_of_near(stack_m: np.ndarray) -> FloatArray:
    """Mean (rows, w) of the readings (n, rows, w), n > 1, that are near each pixel's median."""
    n, *shape = stack_m.shape
    # sorted, NaN last: medians without the cost of nanmedian
    ordered = np.sort(stack_m.reshape(n, -1).T.copy(), axis=1)
    near = np.isfinite(ordered)
    count = np.count_nonzero(near, axis=1)[:, None]
    last = np.maximum(count - 1, 0)
    median = np.take_along_axis(ordered, last // 2, axis=1)
    limit = _NEAR_SHARE * median
    # where the nearest and the farthest are within the share, all are, whatever the deviation
    most = np.maximum(median - ordered[:, :1], np.take_along_axis(ordered, last, axis=1) - median)
    wide = np.flatnonzero(most > limit)
    off = np.abs(ordered[wide] - median[wide])
    spread = _MAD * np.take_along_axis(np.sort(off, axis=1), last[wide] // 2, axis=1)
    near[wide] = off <= np.maximum(_NEAR_SIGMAS * spread, limit[wide])
    mean = np.where(near, ordered, 0).sum(axis=1, dtype=float) / np.maximum(np.count_nonzero(near, axis=1), 1)
    return np.where(2 * count[:, 0] >= n, mean, np.nan).reshape(shape)

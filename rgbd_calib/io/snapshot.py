"""Snapshots: what a recording of a still scene shows, camera by camera."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rgbd_calib.io.recording import Recording
from rgbd_calib.types import CameraSnapshot

MOST_FRAMES = 30
"""Depth images of a camera that are used, spread over the recording."""
_NEAR_SIGMAS, _NEAR_SHARE = 4.0, 0.02
"""A reading belongs to the mean within both: 2 % is more than one step of a quantised disparity (47 mm at 4 m)."""
_MAD = 1.4826


def read_snapshot(recording: Recording, camera: str) -> CameraSnapshot | None:
    """One camera's part of a snapshot; None where the camera has no depth, or no colour.

    The depth is the mean of the readings near their median: sensors that quantise depth send one of two steps, and the mean
    of many readings lies between.
    """
    depth, color = recording.depth_files[camera], recording.color_files[camera]
    if not depth or not color:
        return None
    frames = [*depth]
    if len(frames) > MOST_FRAMES:
        frames = [frames[i] for i in np.linspace(0, len(frames) - 1, MOST_FRAMES).round().astype(int)]
    stack = np.stack([recording.depth_own_m(camera, frame).astype(np.float32) for frame in frames])
    mean_m, noise_m = averaged(stack)
    return CameraSnapshot(camera, recording.color(camera, next(iter(color))), mean_m, len(frames), noise_m)


def read_snapshots(recording: Recording, cameras: tuple[str, ...]) -> Iterator[CameraSnapshot]:
    """Those of these cameras that have depth and colour."""
    for camera in cameras:
        snapshot = read_snapshot(recording, camera)
        if snapshot is not None:
            yield snapshot


def averaged(stack_m: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Mean (h, w), float64, and deviation of a single reading (h, w), of depth images (n, h, w), metres, NaN where there is none.

    A pixel that fewer than half of the images measured is NaN. One image has no deviation: None.
    """
    if len(stack_m) == 1:
        return stack_m[0].astype(float), None
    n, shape = len(stack_m), stack_m.shape[1:]
    # sorted, NaN last: medians without the cost of nanmedian
    ordered = np.sort(stack_m, axis=0).reshape(n, -1)
    count = np.count_nonzero(np.isfinite(ordered), axis=0)
    columns = np.arange(ordered.shape[1])
    median = ordered[np.maximum(count - 1, 0) // 2, columns]
    apart = np.sort(np.abs(ordered - median), axis=0)
    spread = _MAD * apart[np.maximum(count - 1, 0) // 2, columns]
    near = np.abs(ordered - median) <= np.maximum(_NEAR_SIGMAS * spread, _NEAR_SHARE * median)
    kept = np.maximum(near.sum(axis=0), 1)
    values = np.where(near, ordered, 0).astype(float)
    mean = values.sum(axis=0) / kept
    noise = np.sqrt(np.where(near, (ordered - mean) ** 2, 0).sum(axis=0) / np.maximum(kept - 1, 1))
    enough = 2 * count >= n
    return np.where(enough, mean, np.nan).reshape(shape), np.where(enough, noise, np.nan).reshape(shape)

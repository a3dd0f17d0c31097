"""Snapshots of the still scene straight from the cameras, which are free again between two of them."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rgbd_calib.capture.shots import DepthParams, Photographer
from rgbd_calib.errors import CalibrationError
from rgbd_calib.sensors.discover import find_cameras
from rgbd_calib.sensors.driver import load_drivers
from rgbd_calib.sensors.rig import SensorRig
from rgbd_calib.types import CameraSnapshot


def take_snapshots(
    drivers: tuple[str, ...],
    redist: Path | None,
    devices: Mapping[str, str],
    known: Mapping[str, str],
    frames: int,
    settle_s: float = 2.0,
) -> dict[str, CameraSnapshot]:
    """Open the cameras, take one shot of each, and close them.

    Parameters
    ----------
    devices : {camera: serial number, USB path or uri} to use; empty: all that are attached.
    known : {camera: serial number} of an earlier recording, so that names stay.

    Raises
    ------
    RgbdCalibError
        No camera, one that cannot be opened (another program has it), or none that delivers.
    """
    runtime = load_drivers(drivers, redist)
    try:
        cameras = find_cameras(runtime).assign(devices, known)
        with SensorRig(
            runtime, cameras, lambda *_: None, settle_s=settle_s, keep_depth=frames + 4, allow_unregistered=True
        ) as rig:
            photographer = Photographer(rig, DepthParams(frames), time.monotonic())
            frame_set = photographer.frame_set()
            if frame_set is None:
                raise CalibrationError(
                    f"{', '.join(cameras)}: no frames; images of at least one camera are needed. Look at `rgbd-calib devices`"
                )
            images, infos = photographer.images(frame_set), rig.describe()
    finally:
        runtime.close()
    out = {}
    for name, shot in images.items():
        if shot.depth_raw is not None:
            depth_m = np.where(shot.depth_raw > 0, shot.depth_raw * infos[name].depth_scale, np.nan)
            out[name] = CameraSnapshot(name, shot.color, depth_m, frames)
    return out

"""Rig files: the result, and the files of the same form that hold only intrinsics or only depth biases."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.files import dump_yaml, load_yaml, plain, write_text
from rgbd_calib.io.quality import quality_data, quality_of, statistics_of
from rgbd_calib.io.schema_base import parse
from rgbd_calib.io.schema_parts import (
    DepthBiasModel,
    DepthCameraModel,
    IntrinsicsModel,
    field_data,
)
from rgbd_calib.io.schemas import ClockModel, RigModel
from rgbd_calib.io.tables import short
from rgbd_calib.quality import BiasSamples, Quality
from rgbd_calib.types import Clock, DepthBias, Rig, RigCamera

_KNOWN = (
    "intrinsics",
    "T_world_color",
    "rotation_wxyz",
    "translation_m",
    "covariance",
    "depth_bias",
    "depth_field",
    "depth",
    "clock",
)


def write_rig(path: Path, rig: Rig, boards: Mapping[str, FloatArray] | None = None) -> None:
    """Write a rig; `boards` (a simulation's truth) are T_world_board (4, 4) by frame."""
    write_text(path, dump_yaml(rig_data(rig, boards)))


def rig_data(rig: Rig, boards: Mapping[str, FloatArray] | None = None) -> dict[str, Any]:
    """What a rig file holds, as a mapping."""
    cameras = {name: camera_entry(camera) for name, camera in rig.cameras.items()}
    data: dict[str, Any] = {"format": "rgbd-calib/rig", "version": 1, "reference": rig.reference, "cameras": cameras}
    if boards is not None:
        data["boards"] = dict(boards)
    return data | {"quality": quality_data(rig.quality), "provenance": rig.provenance}


def write_intrinsics(
    path: Path,
    intrinsics: Mapping[str, Intrinsics],
    statistics: Mapping[str, Mapping[str, Any]],
    quality: Mapping[str, Any],
    provenance: Mapping[str, Any],
) -> None:
    """Write intrinsics.yaml; `statistics` are plain numbers by camera."""
    cameras = {
        name: {"intrinsics": IntrinsicsModel.of(value).model_dump(), **statistics.get(name, {})}
        for name, value in intrinsics.items()
    }
    _write_part(path, cameras, quality, provenance)


def write_depth_bias(
    path: Path,
    biases: Mapping[str, DepthBias],
    statistics: Mapping[str, Mapping[str, Any]],
    quality: Mapping[str, Any],
    provenance: Mapping[str, Any],
) -> None:
    """Write depth_bias.yaml; `statistics` are plain numbers by camera."""
    cameras = {
        name: {"depth_bias": DepthBiasModel.of(value).model_dump(exclude_none=True), **statistics.get(name, {})}
        for name, value in biases.items()
    }
    _write_part(path, cameras, quality, provenance)


def read_rig(path: Path) -> Rig:
    """A whole rig: every camera with intrinsics and pose.

    Raises
    ------
    ConfigError
        Not a rig file, or a camera lacks its intrinsics or pose.
    """
    return _rig_of(parse(RigModel, load_yaml(path), path), path)


def read_rig_and_boards(path: Path) -> tuple[Rig, dict[str, FloatArray]]:
    """As :func:`read_rig` and :func:`read_boards`, from one reading of the file."""
    model = parse(RigModel, load_yaml(path), path)
    return _rig_of(model, path), _boards_of(model)


def _rig_of(model: RigModel, path: Path) -> Rig:
    cameras = {}
    for name, camera in model.cameras.items():
        if camera.intrinsics is None or camera.T_world_color is None:
            lacks = "intrinsics" if camera.intrinsics is None else "T_world_color"
            raise ConfigError(f"{path}: cameras.{name}.{lacks} is missing; a rig needs it. Is this a part of a rig?")
        cameras[name] = RigCamera(
            camera.intrinsics.value(),
            np.array(camera.T_world_color),
            np.zeros((6, 6)) if camera.covariance is None else np.array(camera.covariance),
            camera.depth_bias.value() if camera.depth_bias else None,
            statistics_of({k: v for k, v in camera.model_dump(exclude_none=True).items() if k not in _KNOWN}),
            camera.depth_field.value() if camera.depth_field else None,
            camera.depth.value() if camera.depth else None,
            camera.clock.value() if camera.clock else None,
        )
    reference = next(iter(cameras)) if model.reference is None else model.reference
    if reference not in cameras:
        raise ConfigError(f"{path}: reference: {short(reference)} seen, one of {', '.join(cameras)} needed")
    return Rig(reference, cameras, quality_of(model.quality), model.provenance)


def read_intrinsics(path: Path) -> dict[str, Intrinsics]:
    """Intrinsics by camera from a rig file or a part of one."""
    model = parse(RigModel, load_yaml(path), path)
    found = {name: camera.intrinsics.value() for name, camera in model.cameras.items() if camera.intrinsics}
    if not found:
        raise ConfigError(f"{path}: no camera has 'intrinsics'. Make them with `rgbd-calib intrinsics`")
    return found


def read_intrinsics_sd(path: Path) -> dict[str, FloatArray]:
    """Standard deviations (9,) of fx, fy, cx, cy, k1, k2, p1, p2, k3 by camera, of those that have them."""
    model = parse(RigModel, load_yaml(path), path)
    return {name: np.array(camera.intrinsics_sd) for name, camera in model.cameras.items() if camera.intrinsics_sd}


def read_depth_bias(path: Path) -> dict[str, DepthBias]:
    """Depth biases by camera from a rig file or a part of one."""
    model = parse(RigModel, load_yaml(path), path)
    found = {name: camera.depth_bias.value() for name, camera in model.cameras.items() if camera.depth_bias}
    if not found:
        raise ConfigError(f"{path}: no camera has 'depth_bias'. Make it with `rgbd-calib depth-bias`")
    return found


def read_depth_bias_samples(path: Path) -> dict[str, BiasSamples]:
    """The data that depth_bias.yaml was fitted to, by camera, where it has them.

    Raises
    ------
    ConfigError
        They are no such data.
    """
    model = parse(RigModel, load_yaml(path), path)
    found = {name: own["samples"] for name, c in model.cameras.items() if "samples" in (own := c.model_dump())}
    made = quality_of({"depth_bias_samples": found})
    if made.faults:
        raise ConfigError(f"{path}: {made.faults['depth_bias_samples']}. Make it again with `rgbd-calib depth-bias`")
    return dict(made.depth_bias_samples or {})


def read_boards(path: Path) -> dict[str, FloatArray]:
    """T_world_board (4, 4) by frame from a simulation's truth.yaml; empty where there are none."""
    return _boards_of(parse(RigModel, load_yaml(path), path))


def _boards_of(model: RigModel) -> dict[str, FloatArray]:
    return {frame: np.array(T) for frame, T in (model.boards or {}).items()}


def write_timing(
    path: Path, reference: str, clocks: Mapping[str, Clock], quality: Quality, provenance: Mapping[str, Any]
) -> None:
    """Write timing.yaml: a rig file with clocks alone."""
    head = {"format": "rgbd-calib/rig", "version": 1, "reference": reference}
    cameras = {name: {"clock": ClockModel.of(clock).model_dump()} for name, clock in clocks.items()}
    data = head | {"cameras": cameras, "quality": quality_data(quality), "provenance": dict(provenance)}
    write_text(path, dump_yaml(data))


def read_timing(path: Path) -> tuple[str, dict[str, Clock]]:
    """The reference, and clocks by camera, from timing.yaml or any rig file with clocks.

    Raises
    ------
    ConfigError
        No camera has one, or the reference has none.
    """
    model = parse(RigModel, load_yaml(path), path)
    found = {name: own.clock.value() for name, own in model.cameras.items() if own.clock}
    reference = next(iter(found), "") if model.reference is None else model.reference
    if reference not in found:
        raise ConfigError(f"{path}: 'clock' of the cameras expected, none found. Make it with `rgbd-calib sync`")
    return reference, found


def camera_entry(camera: RigCamera) -> dict[str, Any]:
    """What a rig file holds of a camera."""
    entry: dict[str, Any] = {
        "intrinsics": IntrinsicsModel.of(camera.intrinsics).model_dump(),
        "T_world_color": camera.T_world_color,
        "rotation_wxyz": so3.quaternion_wxyz(camera.T_world_color[:3, :3]),
        "translation_m": camera.T_world_color[:3, 3],
        "covariance": camera.covariance,
    }
    if camera.depth_bias is not None:
        entry["depth_bias"] = DepthBiasModel.of(camera.depth_bias).model_dump(exclude_none=True)
    if camera.depth_field is not None:
        entry["depth_field"] = field_data(camera.depth_field)
    if camera.depth_camera is not None:
        entry["depth"] = DepthCameraModel.of(camera.depth_camera).model_dump(exclude_none=True)
    if camera.clock is not None:
        entry["clock"] = ClockModel.of(camera.clock).model_dump()
    return entry | plain(camera.statistics)


def _write_part(path: Path, cameras: dict[str, Any], quality: Mapping[str, Any], provenance: Mapping[str, Any]) -> None:
    head = {"format": "rgbd-calib/rig", "version": 1, "cameras": cameras}
    write_text(path, dump_yaml(head | {"quality": dict(quality), "provenance": dict(provenance)}))

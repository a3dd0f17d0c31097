"""What dataset.yaml says of imported cameras: from what a source states, the images that were written, and the user."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.dataset import CameraInfo, DepthGeometry
from rgbd_calib.io.foreign.folder_writer import Unfinished
from rgbd_calib.io.foreign.source import Kind, SourceCamera
from rgbd_calib.io.sniff import Sniffed, sniff
from rgbd_calib.pipeline.config import load_config
from rgbd_calib.pipeline.detection import Progress, silent
from rgbd_calib.pipeline.init_recording import Answers, FolderContents, look_at, with_unit
from rgbd_calib.types import Board

Ask = Callable[[str], float | None]
"""A question to the user about metres for each unit; None: there is nobody to ask."""
UNIT_REMEDY = (
    "Give the same command with --depth-scale (0.001 for millimetres, 0.0002 for TUM's 5000 a metre), or with --board and "
    "--square as measured"
)


@dataclass(frozen=True)
class CameraOptions:
    """What the user says of all cameras."""

    board: Board | None = None
    depth_scale: float | None = None
    """Metres for each unit of depth."""
    registered: bool | None = None
    """None: as the source says; where it does not, depth of colour's size is registered."""


def describe_cameras(
    folder: Path,
    said: Mapping[str, SourceCamera],
    options: CameraOptions,
    ask: Ask,
    progress: Progress = silent,
) -> tuple[dict[str, CameraInfo], list[str]]:
    """The cameras of the images in `folder` (CAM/color/STEM and so on), and what was concluded.

    Raises
    ------
    ConfigError
        Images of another size than the lens, or depth that cannot be registered.
    Unfinished
        The unit of depth is not known.
    """
    cameras: dict[str, CameraInfo] = {}
    remarks: list[str] = []
    for name, own in said.items():
        color = first_image(folder, name, "color")
        if color is None:
            continue
        info = CameraInfo(color.width, color.height, serial=own.serial, intrinsics=_fitting(name, own, color))
        depth = first_image(folder, name, "depth") or first_image(folder, name, "ir")
        cameras[name] = info if depth is None else _with_geometry(name, info, own, depth, options.registered, remarks)
    found: FolderContents | None = None
    for name, info in cameras.items():
        depth = first_image(folder, name, "depth")
        if depth is None:
            continue
        if found is None:
            found = look_at(folder, _PATTERNS)
        own = said[name]
        info = replace(info, invalid=own.invalid)
        floating = depth.pixels == "float"
        if options.depth_scale is None and not floating and own.depth_scale is not None:
            cameras[name] = replace(info, depth_scale=own.depth_scale, depth_stated=True)
        elif options.depth_scale is None and floating and own.float_unit_m is not None:
            cameras[name] = replace(
                info, float_unit_m=own.float_unit_m, depth_scale=own.float_unit_m, depth_stated=True
            )
        else:
            cameras[name], remark = _with_unit(found, name, info, options, ask, progress)
            remarks.append(remark)
    return cameras, remarks


_PATTERNS: dict[Kind, str] = {kind: f"{{camera}}/{kind}/{{frame}}.*" for kind in ("color", "depth", "ir")}


def first_image(folder: Path, camera: str, kind: Kind) -> Sniffed | None:
    """Type and size of the images of a kind, which are alike; None where there are none."""
    own = folder / camera / kind
    path = min((p for p in own.iterdir() if not p.name.startswith(".")), default=None) if own.is_dir() else None
    return None if path is None else sniff(path)


def _fitting(name: str, own: SourceCamera, color: Sniffed) -> Intrinsics | None:
    lens = own.intrinsics
    if lens is not None and (lens.width, lens.height) != (color.width, color.height):
        raise ConfigError(
            f"{name}: images of {color.width}x{color.height} px seen, its lens is for {lens.width}x{lens.height}. Choose the "
            "topic that fits camera_info, or take the calibration file out"
        )
    return lens


def _with_geometry(
    name: str, info: CameraInfo, own: SourceCamera, depth: Sniffed, said: bool | None, remarks: list[str]
) -> CameraInfo:
    size = (depth.width, depth.height)
    same = size == (info.width, info.height)
    registered = own.registered if said is None else said
    if registered is None:
        registered = same
        state = "the size of colour and is taken as registered to it (--unregistered if it is not)"
        other = f"{size[0]}x{size[1]} px, colour {info.width}x{info.height}: it is taken as not registered (--registered if it is)"
        remarks.append(f"{name}: depth has {state if same else other}")
    if registered and same:
        return info
    if registered:  # the same view at another size
        return replace(info, depth=DepthGeometry(*size, T_color_depth=np.eye(4)))
    lens = own.depth_intrinsics
    if lens is not None and (lens.width, lens.height) != size:
        remarks.append(
            f"{name}: the lens of depth is for {lens.width}x{lens.height} px, its images have {size[0]}x{size[1]}: not used"
        )
        lens = None
    return replace(info, depth=DepthGeometry(*size, lens, None, own.T_color_depth))


def _with_unit(
    found: FolderContents, name: str, info: CameraInfo, options: CameraOptions, ask: Ask, progress: Progress
) -> tuple[CameraInfo, str]:
    config, answers = load_config(None), Answers(options.board, options.depth_scale)
    told, remark = with_unit(found, name, info, answers, config, progress)
    if told.depth_stated:
        return told, remark
    answer = ask(f"{remark}. Metres for each unit of its depth")
    if answer is None:
        raise Unfinished(
            f"{remark}, so that the unit of its depth is not known. {UNIT_REMEDY}; what is written so far is kept"
        )
    return with_unit(found, name, info, replace(answers, depth_scale=answer), config, progress)

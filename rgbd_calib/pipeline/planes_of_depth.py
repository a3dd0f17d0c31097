"""Depth cameras that see no corners, among views of the others: where they are thought to be, and their depth of the board."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.recording import Recording
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.depth_cameras import predicted_views, without_corners
from rgbd_calib.types import Board, DepthBias, PosedView
from rgbd_calib.views.association import AssociationResult
from rgbd_calib.views.depth_scale import check_axis, check_depth_scale
from rgbd_calib.views.plane_filter import filter_planes


def with_depth_cameras(
    association: AssociationResult,
    recording: Recording,
    lenses: Mapping[str, Intrinsics],
    biases: Mapping[str, DepthBias],
    board: Board,
    config: Config,
) -> AssociationResult:
    """The association with these cameras of a split recording after the others; unchanged where there are none.

    Raises
    ------
    ConfigError
        The method needs registered depth.
    CalibrationError
        The depth's unit or axis is wrong: see :mod:`rgbd_calib.views.depth_scale`.
    """
    mounted = without_corners(recording)
    if not mounted:
        return association
    if config.method != "bundle":
        raise ConfigError(
            f"{recording.path}: depth of {', '.join(m.camera for m in mounted.values())} is not registered to colour, and has no "
            f"infrared images; method {config.method} needs registered depth. Take method bundle, or register it first, with "
            "`rgbd-calib calibrate` and `rgbd-calib correct`"
        )
    poses = dict(association.T_world_color)
    for name, mount in mounted.items():
        assert mount.T_color_depth is not None  # seen to with the lenses
        poses[name] = poses[mount.camera] @ mount.T_color_depth
    poses = {name: poses[name] for name in recording.cameras}
    read = predicted_views(association.views, recording, lenses, poses, board)
    on_plane = filter_planes([p.view for p in read], lenses, biases, config.plane_filter, config.seed)
    views = [replace(p, view=view) for p, view in zip(read, on_plane.views, strict=True)]
    posed = [PosedView(p.view, p.T_color_board @ board.T_face_board(p.back, p.turned), 0.0) for p in views]
    check_depth_scale(posed, board, biases, config.bundle.bias_scale_sd)
    check_axis(posed, board)
    return replace(association, views=(*association.views, *views), T_world_color=poses)

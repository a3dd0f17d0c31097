"""Depth with a geometry of its own: each such camera is calibrated as two, colour and a depth camera beside it.

The depth camera, NAME/depth, takes part as any other. Where it has infrared images it sees the board's corners in them, and
its depth is registered to them. Where it has none, its depth is read where its colour camera says that the board is, and
corners say nothing of it: the board's plane does (D. Herrera, J. Kannala, J. Heikkila, IEEE PAMI 34(10), 2012). In the rig
the two are one camera again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.dataset import CameraInfo, Mount
from rgbd_calib.io.layout import KINDS, Files, Kind
from rgbd_calib.io.recording import Recording
from rgbd_calib.quality import AlignmentNumbers, CameraStatistics, ExpectedPair, overlaid
from rgbd_calib.trust.uncertainty import JointCovariance
from rgbd_calib.types import Board, BoardView, DepthCamera, PlacedView, Rig, RigCamera
from rgbd_calib.views.detect import corner_depth

MIN_CORNERS = 6
"""Corners inside the depth image; a plane is determined by three."""
PairNumbers = TypeVar("PairNumbers", ExpectedPair, AlignmentNumbers)


def name_of(camera: str) -> str:
    """Of a camera's depth; no camera of a recording has such a name."""
    return f"{camera}/depth"


def split(recording: Recording) -> Recording:
    """The recording with depth of its own geometry as cameras of their own; unchanged where there is none."""
    own = [c for c, info in recording.cameras.items() if info.depth is not None and recording.depth_files[c]]
    if not own:
        return recording
    cameras: dict[str, CameraInfo] = {}
    listed: dict[Kind, Files] = {kind: {} for kind in KINDS}
    files = {"color": recording.color_files, "depth": recording.depth_files, "ir": recording.ir_files}
    for camera, info in recording.cameras.items():
        cameras[camera] = replace(info, depth=None)
        for kind in KINDS:
            listed[kind][camera] = files[kind][camera] if camera not in own or kind == "color" else {}
        if camera in own and info.depth is not None:
            depth, name = info.depth, name_of(camera)
            mount = Mount(camera, depth.T_color_depth, depth.intrinsics_sd)
            cameras[name] = replace(
                info, width=depth.width, height=depth.height, intrinsics=depth.intrinsics, depth=None, mount=mount
            )
            listed["color"][name], listed["depth"][name] = files["ir"][camera], files["depth"][camera]
            listed["ir"][name] = {}
    return replace(recording, cameras=cameras, listed=listed)


def split_rig(rig: Rig, recording: Recording) -> Rig:
    """The rig with the depth cameras of a split recording as cameras of their own, as far as it has them."""
    cameras: dict[str, RigCamera] = {}
    for name, own in rig.cameras.items():
        cameras[name] = own
        depth, info = own.depth_camera, recording.cameras.get(name_of(name))
        if depth is not None and info is not None:
            cameras[name] = replace(own, depth_camera=None, depth_bias=None, depth_field=None)
            cameras[name_of(name)] = RigCamera(
                depth.intrinsics,
                own.T_world_color @ depth.T_color_depth,
                own.covariance,
                own.depth_bias,
                own.statistics.depth_statistics or CameraStatistics(),
                own.depth_field,
            )
    return replace(rig, cameras=cameras)


def joined(rig: Rig, cameras: Mapping[str, CameraInfo], joint: JointCovariance | None) -> Rig:
    """The rig with each depth camera as a part of its colour camera again."""
    out = {name: own for name, own in rig.cameras.items() if cameras[name].mount is None}
    for name, info in cameras.items():
        if info.mount is not None and name in rig.cameras:
            color, depth = rig.cameras[info.mount.camera], rig.cameras[name]
            T_color_depth = se3.inverse(color.T_world_color) @ depth.T_world_color
            sensor = DepthCamera(depth.intrinsics, T_color_depth, _covariance(color, info.mount.camera, name, joint))
            out[info.mount.camera] = replace(
                color,
                depth_bias=depth.depth_bias,
                depth_field=depth.depth_field,
                depth_camera=sensor,
                statistics=replace(color.statistics, depth_statistics=depth.statistics),
            )
    return replace(rig, cameras=out)


def _covariance(color: RigCamera, name: str, depth: str, joint: JointCovariance | None) -> FloatArray | None:
    """(10, 10) of fx, fy, cx, cy of the depth camera and the left perturbation of T_color_depth, Ad(T_color_world)(b - a)."""
    if joint is None or "intrinsics" not in joint.parameters[depth]:
        return None
    own, other = joint.parameters[depth], joint.parameters[name]
    at = np.concatenate([own["intrinsics"][:4], own["pose"], other["pose"]])
    J = np.zeros((10, 16))
    J[:4, :4] = np.eye(4)
    J[4:, 4:10] = se3.adjoint(se3.inverse(color.T_world_color))
    J[4:, 10:] = -J[4:, 4:10]
    return np.asarray(J @ joint.matrix[np.ix_(at, at)] @ J.T)


def by_device(pairs: Mapping[str, PairNumbers]) -> dict[str, PairNumbers]:
    """Numbers of pairs of cameras by the devices that these are of; of one device's own two sensors as they are."""
    out: dict[str, PairNumbers] = {}
    for key, numbers in pairs.items():
        a, b = (name.removesuffix(name_of("")) for name in key.split(" - "))
        name = key if a == b else f"{a} - {b}"
        if name not in out:
            out[name] = numbers
        elif numbers.points:
            out[name] = overlaid(out[name], numbers)
    return out


def without_corners(recording: Recording) -> dict[str, Mount]:
    """Depth cameras of a split recording that have no infrared images, by name."""
    return {
        name: info.mount
        for name, info in recording.cameras.items()
        if info.mount is not None and not recording.color_files[name]
    }


def predicted_views(
    placed: Sequence[PlacedView],
    recording: Recording,
    lenses: Mapping[str, Intrinsics],
    T_world_color: Mapping[str, FloatArray],
    board: Board,
) -> tuple[PlacedView, ...]:
    """Depth of the board, read where the views of its colour camera say that the board is.

    Parameters
    ----------
    placed : views of colour cameras.
    lenses, T_world_color : of the colour and the depth cameras.
    """
    out = []
    for name, mount in without_corners(recording).items():
        if name not in T_world_color or mount.camera not in T_world_color:
            continue
        T_depth_color = se3.inverse(T_world_color[name]) @ T_world_color[mount.camera]
        for one in placed:
            if one.view.camera == mount.camera and recording.has_depth(name, one.view.frame):
                T = T_depth_color @ one.T_color_board
                view = _predicted(name, one, T, recording, lenses[name], board)
                if view is not None:
                    out.append(replace(one, view=view, T_color_board=T))
    return tuple(out)


def _predicted(
    name: str, placed: PlacedView, T_depth_board: FloatArray, recording: Recording, lens: Intrinsics, board: Board
) -> BoardView | None:
    p = se3.transform(T_depth_board, placed.points_m(board))
    pixels = lens.project(p)
    inside = np.all((pixels >= 0) & (pixels <= lens.size_px - 1), axis=1) & (p[:, 2] > 0)
    if inside.sum() < MIN_CORNERS:
        return None
    view, ids, at = placed.view, placed.view.ids[inside], pixels[inside]
    depth_m, n = corner_depth(recording.depth_m(name, view.frame), board, ids, at, np.random.default_rng(0))
    return BoardView(name, view.frame, ids, at, depth_m, n, predicted=True)


def at_the_corners(
    placed: Sequence[PlacedView], rig: Rig, cameras: Mapping[str, CameraInfo], board: Board
) -> tuple[PlacedView, ...]:
    """Views whose corners were predicted, moved to where a rig has them, with the depth that their planes have there."""
    seen = {(p.view.camera, p.view.frame): p for p in placed if not p.view.predicted}
    out = []
    for one in placed:
        mount = cameras[one.view.camera].mount
        if one.view.predicted and mount is not None:
            view, lens = one.view, rig.cameras[one.view.camera].intrinsics
            T_depth_color = (
                se3.inverse(rig.cameras[view.camera].T_world_color) @ rig.cameras[mount.camera].T_world_color
            )
            T = T_depth_color @ seen[mount.camera, view.frame].T_color_board
            pixels = lens.project(se3.transform(T, one.points_m(board)))
            along = [lens.rays(at) @ T[:3, 2] for at in (view.corners_px, pixels)]
            one = replace(
                one, view=replace(view, corners_px=pixels, depth_m=view.depth_m * along[0] / along[1]), T_color_board=T
            )
        out.append(one)
    return tuple(out)

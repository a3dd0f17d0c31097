"""The rig in 3D for the report: frusta, boards, clouds, and the working volume coloured by its expected error.

What moves with the slider from before to after has, in its trace's `meta`, where it was before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.patterns.black import rim_m
from rgbd_calib.report.error_map import top_mm
from rgbd_calib.report.plots import Figure, css_color, longest, plain
from rgbd_calib.types import Board, Rig, RigCamera

_FRUSTUM_SHARE = 0.1  # depth of a frustum, as share of the rig's extent


@dataclass(frozen=True)
class MovedCloud:
    """Pixels of one camera's depth image as points in the world, by the rig before and after; (n, 3), metres."""

    camera: str
    before_m: FloatArray
    after_m: FloatArray


def scene(
    rig: Rig,
    boards: Mapping[str, FloatArray],
    board: Board | None,
    grid_m: FloatArray,
    error_mm: FloatArray,
    start: Rig | None = None,
    clouds: Sequence[MovedCloud] = (),
) -> Figure:
    """Cameras, boards (T_world_board by frame), points (n, 3), metres, in the world with their error (n,), mm, and clouds.

    `start` is the rig before; None: only one is shown.
    """
    centers = np.array([own.T_world_color[:3, 3] for own in rig.cameras.values()])
    corners = [_outline(T, board) for T in boards.values()] if board is not None else []
    everything = np.concatenate([centers, *corners, grid_m])
    size_m = _FRUSTUM_SHARE * (float(np.max(np.ptp(everything, axis=0))) or 1.0)
    traces = []
    if len(grid_m):
        traces.append(_volume(grid_m, error_mm, hidden=bool(clouds)))
    if corners:
        traces.append(_lines("boards", np.concatenate([_broken(c) for c in corners]), "#8a8a8a", 2))
    for i, (name, own) in enumerate(rig.cameras.items()):
        first = start.cameras[name] if start is not None and name in start.cameras else None
        traces += _frustum(name, own, first, size_m, css_color(i))
    numbers = {name: i for i, name in enumerate(rig.cameras)}
    traces += [_cloud(cloud, css_color(numbers[cloud.camera])) for cloud in clouds]
    return {"data": traces, "layout": _layout(rig)}


def scene_of_two(first: Rig, second: Rig, grid_m: FloatArray, error_mm: FloatArray) -> tuple[Figure, float]:
    """Two rigs in one frame, the second dashed, with the volume (n, 3) of the first and its error (n,).

    Lines lead from each optical centre where it went, lengthened; by how much is returned too.
    """
    places = [own.T_world_color[:3, 3] for rig in (first, second) for own in rig.cameras.values()]
    extent_m = float(np.max(np.ptp(np.concatenate([places, grid_m]), axis=0))) or 1.0
    traces = [_volume(grid_m, error_mm, hidden=True)] if len(grid_m) else []
    names = list(dict.fromkeys([*first.cameras, *second.cameras]))
    for i, name in enumerate(names):
        for rig, which, dash in ((first, "first", "solid"), (second, "second", "dash")):
            if name in rig.cameras:
                lines, label = _frustum(name, rig.cameras[name], None, _FRUSTUM_SHARE * extent_m, css_color(i))
                lines["line"]["dash"], lines["name"] = dash, f"{name}, {which}"
                traces += [lines, label] if rig is first or name not in first.cameras else [lines]
    both = [name for name in names if name in first.cameras and name in second.cameras]
    start, end = (np.array([rig.cameras[name].T_world_color[:3, 3] for name in both]) for rig in (first, second))
    scale = longest(end - start, 2 * _FRUSTUM_SHARE * extent_m)
    gap = np.full_like(start, np.nan)
    path = np.stack([start, start + scale * (end - start), gap], axis=1).reshape(-1, 3)
    traces.append(_lines("motion, magnified", path, "#222222", 6))
    return {"data": traces, "layout": _layout(first)}, scale


def _cloud(cloud: MovedCloud, color: str) -> dict[str, Any]:
    return {
        "type": "scatter3d",
        "mode": "markers",
        "name": f"{cloud.camera}, depth",
        **_xyz(cloud.after_m, 3),
        "meta": {"before": _xyz(cloud.before_m, 3)},
        "marker": {"size": 1.6, "color": color, "opacity": 0.8},
        "hoverinfo": "name",
    }


def _xyz(points_m: FloatArray, digits: int) -> dict[str, Any]:
    return dict(zip("xyz", (plain(v) for v in np.round(points_m, digits).T), strict=True))


def _volume(grid_m: FloatArray, error_mm: FloatArray, hidden: bool) -> dict[str, Any]:
    return {
        "type": "scatter3d",
        "mode": "markers",
        "name": "expected error",
        "visible": "legendonly" if hidden else True,
        **_xyz(grid_m, 3),
        "text": [f"{e:.2f} mm" for e in error_mm],
        "hovertemplate": "expected error %{text}<extra></extra>",
        "marker": {
            "size": 3.5,
            "opacity": 0.75,
            "color": plain(np.round(error_mm, 3)),
            "colorscale": "Viridis",
            "reversescale": True,
            "cmin": 0,
            "cmax": top_mm(error_mm),
            "colorbar": {
                "title": {"text": "expected error, mm", "side": "right"},
                "thickness": 12,
                "len": 0.8,
                "x": 1.0,
            },
        },
    }


def _frustum(name: str, own: RigCamera, start: RigCamera | None, depth_m: float, color: str) -> list[dict[str, Any]]:
    path, behind = _pyramid(own, depth_m)
    label = {
        "type": "scatter3d",
        "mode": "text",
        **_xyz(behind[None], 4),
        "text": [name],
        "textposition": "middle center",
        "textfont": {"color": color, "size": 15},
        "hoverinfo": "skip",
        "showlegend": False,
        "legendgroup": name,
    }
    lines = _lines(name, path, color, 5) | {"legendgroup": name}
    if start is not None:
        first, first_behind = _pyramid(start, depth_m)
        lines["meta"], label["meta"] = {"before": _xyz(first, 4)}, {"before": _xyz(first_behind[None], 4)}
    return [lines, label]


def _pyramid(camera: RigCamera, depth_m: float) -> tuple[FloatArray, FloatArray]:
    """Its edges as one path (12, 3), metres, in the world, and a place (3,) behind it for the name."""
    own, T = camera.intrinsics, camera.T_world_color
    w, h = own.width - 1.0, own.height - 1.0
    pixels = np.array([[0, 0], [w, 0], [w, h], [0, h]])
    rays = own.rays(pixels)
    if not np.isfinite(rays).all():  # the lens model has no ray at a corner of the image
        rays = np.column_stack([(pixels - [own.cx, own.cy]) / [own.fx, own.fy], np.ones(4)])
    a, b, c, d = se3.transform(T, depth_m * rays)
    o = T[:3, 3]
    return np.stack([o, a, b, o, c, d, o, a, d, o, b, c]), se3.transform(T, np.array([0, 0, -0.6 * depth_m]))


def _lines(name: str, points: FloatArray, color: str, width: int) -> dict[str, Any]:
    return {
        "type": "scatter3d",
        "mode": "lines",
        "name": name,
        **_xyz(points, 4),
        "line": {"color": color, "width": width},
        "hoverinfo": "name",
        "connectgaps": False,
    }


def _outline(T_world_board: FloatArray, board: Board) -> FloatArray:
    (w, h), s = board.grid[-1] * board.square_m, rim_m(board)
    rim = np.array([[-s, -s, 0], [w + s, -s, 0], [w + s, h + s, 0], [-s, h + s, 0], [-s, -s, 0]])
    return se3.transform(T_world_board, rim)


def _broken(points: FloatArray) -> FloatArray:
    """With a gap at the end."""
    return np.concatenate([points, np.full((1, 3), np.nan)])


def _layout(rig: Rig) -> dict[str, Any]:
    R = np.array([own.T_world_color[:3, :3] for own in rig.cameras.values()])
    up = -R[:, :, 1].mean(axis=0)
    up = -R[0, :, 1] if np.linalg.norm(up) < 0.3 else up / np.linalg.norm(up)
    forward = R[:, :, 2].mean(axis=0)
    forward = R[0, :, 2] if np.linalg.norm(forward) < 0.3 else forward / np.linalg.norm(forward)
    side = np.cross(forward, up)
    eye = -1.3 * forward + 0.85 * up + 0.7 * side
    axis = {
        "showbackground": False,
        "gridcolor": "#e4e4e4",
        "zerolinecolor": "#c8c8c8",
        "ticksuffix": " m",
        "nticks": 5,
    }

    def vector(v: FloatArray) -> dict[str, float]:
        return dict(zip("xyz", (round(float(x), 3) for x in v), strict=True))

    return {
        "height": 560,
        "margin": {"l": 0, "r": 0, "t": 0, "b": 40},
        "legend": {"orientation": "h", "y": -0.01, "yanchor": "top", "itemsizing": "constant"},
        "scene": {
            "aspectmode": "data",
            "camera": {"up": vector(up), "eye": vector(eye)},
            **{f"{a}axis": axis | {"title": {"text": a}} for a in "xyz"},
        },
    }

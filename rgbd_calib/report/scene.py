"""The rig in 3D for the report: frusta, boards, and the working volume coloured by its expected error."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rgbd_calib.geometry import camera as lens
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.report.figures import Figure, css_color, plain
from rgbd_calib.types import Board, Rig

_FRUSTUM_SHARE = 0.1  # depth of a frustum, as share of the rig's extent


def scene(
    rig: Rig, boards: Mapping[str, FloatArray], board: Board | None, grid_m: FloatArray, error_mm: FloatArray
) -> Figure:
    """Cameras, boards (T_world_board by frame) and points (n, 3), metres, in the world with their error (n,), mm."""
    centers = np.array([own.T_world_color[:3, 3] for own in rig.cameras.values()])
    corners = [_outline(T, board) for T in boards.values()] if board is not None else []
    everything = np.concatenate([centers, *corners, grid_m])
    size = float(np.max(np.ptp(everything, axis=0))) or 1.0
    traces = []
    if len(grid_m):
        traces.append(_volume(grid_m, error_mm))
    if corners:
        traces.append(_lines("boards", np.concatenate([_broken(c) for c in corners]), "#8a8a8a", 2))
    for i, (name, own) in enumerate(rig.cameras.items()):
        traces += _frustum(name, own.T_world_color, own.intrinsics, _FRUSTUM_SHARE * size, css_color(i))
    return {"data": traces, "layout": _layout(rig)}


def _volume(grid_m: FloatArray, error_mm: FloatArray) -> dict[str, Any]:
    top = float(np.percentile(error_mm, 98))
    x, y, z = np.round(grid_m, 3).T
    return {
        "type": "scatter3d",
        "mode": "markers",
        "name": "expected error",
        "x": plain(x),
        "y": plain(y),
        "z": plain(z),
        "text": [f"{e:.2f} mm" for e in error_mm],
        "hovertemplate": "expected error %{text}<extra></extra>",
        "marker": {
            "size": 3.5,
            "opacity": 0.75,
            "color": plain(np.round(error_mm, 3)),
            "colorscale": "Viridis",
            "reversescale": True,
            "cmin": 0,
            "cmax": top,
            "colorbar": {
                "title": {"text": "expected error, mm", "side": "right"},
                "thickness": 12,
                "len": 0.8,
                "x": 1.0,
            },
        },
    }


def _frustum(name: str, T: FloatArray, own: lens.Intrinsics, depth_m: float, color: str) -> list[dict[str, Any]]:
    w, h = own.width - 1.0, own.height - 1.0
    rays = own.rays(np.array([[0, 0], [w, 0], [w, h], [0, h]]))
    if not np.isfinite(rays).all():  # the lens model has no ray at a corner of the image
        pixels = np.array([[0, 0], [w, 0], [w, h], [0, h]])
        rays = np.column_stack([(pixels - [own.cx, own.cy]) / [own.fx, own.fy], np.ones(4)])
    a, b, c, d = se3.transform(T, depth_m * rays)
    o, behind = T[:3, 3], se3.transform(T, np.array([0, 0, -0.6 * depth_m]))
    path = np.stack([o, a, b, o, c, d, o, a, d, o, b, c])
    label = {
        "type": "scatter3d",
        "mode": "text",
        "x": [float(behind[0])],
        "y": [float(behind[1])],
        "z": [float(behind[2])],
        "text": [name],
        "textposition": "middle center",
        "textfont": {"color": color, "size": 15},
        "hoverinfo": "skip",
        "showlegend": False,
        "legendgroup": name,
    }
    return [_lines(name, path, color, 5) | {"legendgroup": name}, label]


def _lines(name: str, points: FloatArray, color: str, width: int) -> dict[str, Any]:
    x, y, z = np.round(points, 4).T
    return {
        "type": "scatter3d",
        "mode": "lines",
        "name": name,
        "x": plain(x),
        "y": plain(y),
        "z": plain(z),
        "line": {"color": color, "width": width},
        "hoverinfo": "name",
        "connectgaps": False,
    }


def _outline(T_world_board: FloatArray, board: Board) -> FloatArray:
    w, h, s = (board.cols - 1) * board.square_m, (board.rows - 1) * board.square_m, board.square_m
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

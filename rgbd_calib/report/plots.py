"""Pieces that the report's figures share, as plotly's plain mappings {"data": [...], "layout": {...}}."""

from __future__ import annotations

from typing import Any

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.report.splat import camera_color

Figure = dict[str, Any]

GRID_COLOR = "#e4e4e4"
SIZES = [[0, "#ffffff"], [1, "#3f7ab0"]]
"""Colours of what has no sign."""
SIGNS = [[0, "#2f5fa8"], [0.5, "#f7f7f7"], [1, "#c2412d"]]
"""Colours of what has one: red is too far or more, blue too near or less."""
_HEAD = np.exp(1j * np.pi * np.array([0.85, -0.85])) * 0.3
"""The two strokes of an arrow's head, in units of the arrow."""


def css_color(index: int) -> str:
    """Colour of camera number `index`."""
    return "rgb({}, {}, {})".format(*camera_color(index))


def plain(values: Any) -> list[Any]:
    """Numbers of any shape as lists for JSON; NaN becomes None."""
    array = np.asarray(values, float)
    out = array.astype(object)
    out[~np.isfinite(array)] = None
    return list(out.tolist())


def dots(name: str, z_m: FloatArray, off_m: FloatArray, color: str, size: int, symbol: str) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "markers",
        "name": name,
        "x": plain(np.round(z_m, 4)),
        "y": plain(np.round(1e3 * off_m, 3)),
        "marker": {"color": color, "size": size, "symbol": symbol},
    }


def line(name: str, x: FloatArray, y: FloatArray, index: int) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "name": name,
        "x": plain(np.round(x, 4)),
        "y": plain(np.round(y, 5)),
        "line": {"color": css_color(index), "width": 1.6},
        "marker": {"size": 5},
    }


def axes(x: str, y: str) -> dict[str, Any]:
    axis = {"gridcolor": GRID_COLOR, "zerolinecolor": "#bbb", "automargin": True}
    return {
        "height": 330,
        "margin": {"l": 56, "r": 12, "t": 8, "b": 48},
        "xaxis": axis | {"title": {"text": x}},
        "yaxis": axis | {"title": {"text": y}},
        "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0},
    }


def longest(d: FloatArray, room: float) -> float:
    """By how much arrows d (..., 2) are lengthened to fill `room`, to one digit: their 95th percentile counts."""
    lengths = np.linalg.norm(d, axis=-1)
    lengths = lengths[np.isfinite(lengths)]
    top = float(np.percentile(lengths, 95)) if len(lengths) else 0.0
    return float(f"{room / top:.1g}") if top > 0 else 1.0


def arrows(at: FloatArray, d: FloatArray, name: str = "", color: str = "#222", width: float = 1.6) -> dict[str, Any]:
    """Arrows from points (..., 2) by d (..., 2), as one trace of lines."""
    start = (at[..., 0] + 1j * at[..., 1]).ravel()
    step = (d[..., 0] + 1j * d[..., 1]).ravel()
    ok = np.isfinite(step)
    start, step = start[ok], step[ok]
    end, gap = start + step, np.full(len(start), np.nan)
    path = np.stack([start, end, end + step * _HEAD[0], end, end + step * _HEAD[1], gap], axis=1).ravel()
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": plain(np.round(path.real, 2)),
        "y": plain(np.round(path.imag, 2)),
        "line": {"color": color, "width": width},
        "hoverinfo": "skip",
        "showlegend": bool(name),
    }


def heat(x: FloatArray, y: FloatArray, z: FloatArray, hover: str, colors: list[Any], low: float, high: float) -> Figure:
    """Values z (len(y), len(x)) as colours; NaN stays empty."""
    return {
        "type": "heatmap",
        "x": plain(np.round(x, 2)),
        "y": plain(np.round(y, 2)),
        "z": plain(np.round(z, 4)),
        "colorscale": colors,
        "zmin": low,
        "zmax": high,
        "hovertemplate": hover + "<extra></extra>",
        "hoverongaps": False,
        "showscale": False,
    }


def scale_bar(title: str) -> dict[str, Any]:
    """For a heatmap: its colours beside it, with a title that has the unit."""
    bar = {"title": {"text": title, "side": "right"}, "thickness": 10, "len": 0.95, "outlinewidth": 0}
    return {"showscale": True, "colorbar": bar}


def image_layout(left: float, right: float, top: float, bottom: float, height: int = 205) -> dict[str, Any]:
    """Of a part of an image, px, without ticks; y goes down."""
    axis = {"showgrid": False, "zeroline": False, "ticks": "", "showticklabels": False}
    return {
        "height": height,
        "margin": {"l": 2, "r": 2, "t": 4, "b": 4},
        "plot_bgcolor": "#e9ebee",
        "showlegend": False,
        "xaxis": axis | {"range": [left, right], "constrain": "domain"},
        "yaxis": axis | {"range": [bottom, top], "scaleanchor": "x", "constrain": "domain"},
    }

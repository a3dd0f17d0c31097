"""Figures of the report, as plotly's plain mappings {"data": [...], "layout": {...}}."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.residuals import Residuals
from rgbd_calib.report.numbers import Cells, DistanceBins, ViewResidual
from rgbd_calib.report.splat import camera_color
from rgbd_calib.types import DepthBias
from rgbd_calib.views.coverage import CameraCoverage, CoverageParams

Figure = dict[str, Any]

_GRID = "#e4e4e4"
_ARROW_SHARE = 0.9  # longest arrow, as share of a cell
_LOG_TICKS = [float(f"{m}e{e}") for e in range(-4, 5) for m in (1, 1.5, 2, 3, 5, 7)]
_SIZES = [[0, "#ffffff"], [1, "#3f7ab0"]]
_SIGNS = [[0, "#2f5fa8"], [0.5, "#f7f7f7"], [1, "#c2412d"]]


def css_color(index: int) -> str:
    """Colour of camera number `index`."""
    return "rgb({}, {}, {})".format(*camera_color(index))


def plain(values: Any) -> list[Any]:
    """Numbers of any shape as lists for JSON; NaN becomes None."""
    array = np.asarray(values, float)
    out = array.astype(object)
    out[~np.isfinite(array)] = None
    return list(out.tolist())


def coverage_map(coverage: CameraCoverage) -> Figure:
    """How many views put a corner into each region of one image."""
    counts = coverage.regions
    return {
        "data": [
            {
                "type": "heatmap",
                "z": counts.tolist(),
                "text": counts.tolist(),
                "texttemplate": "%{text}",
                "hovertemplate": "%{z} views<extra></extra>",
                "colorscale": [[0, "#f3d9d3"], [0.001, "#eef3f7"], [1, "#4f86b8"]],
                "zmin": 0,
                "zmax": max(int(counts.max()), 1),
                "showscale": False,
                "xgap": 2,
                "ygap": 2,
            }
        ],
        "layout": {
            "height": 200,
            "margin": {"l": 8, "r": 8, "t": 8, "b": 8},
            "xaxis": {"visible": False},
            "yaxis": {"visible": False, "autorange": "reversed", "scaleanchor": "x"},
        },
    }


def depth_ranges(coverage: Mapping[str, CameraCoverage], params: CoverageParams) -> Figure:
    """Views of each camera by distance of the board."""
    edges = params.distance_edges_m
    labels = [f"{a:g}-{b:g} m" if np.isfinite(b) else f"> {a:g} m" for a, b in pairwise(edges)]
    table = np.array([own.distances for own in coverage.values()])
    used = np.flatnonzero(table.sum(axis=0))
    shown = slice(used.min(), used.max() + 1) if len(used) else slice(0, 0)
    traces = [
        {"type": "bar", "name": name, "x": labels[shown], "y": row[shown].tolist(), "marker": {"color": css_color(i)}}
        for i, (name, row) in enumerate(zip(coverage, table, strict=True))
    ]
    return {"data": traces, "layout": _axes("distance of the board", "views") | {"barmode": "group", "height": 300}}


def views(rows: Sequence[ViewResidual], cameras: Sequence[str], depth: bool) -> Figure:
    """RMS of every view, in px or of depth in mm; crosses are views that were left out."""
    order = list(dict.fromkeys(row.frame for row in rows))
    traces = []
    for i, name in enumerate(cameras):
        for used in (True, False):
            own = [r for r in rows if r.camera == name and (r.used_depth if depth else r.used_pixel) == used]
            values = np.array([1e3 * r.rms_depth_m if depth else r.rms_px for r in own])
            if not np.isfinite(values).any():
                continue
            traces.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": name if used else f"{name}, left out",
                    "x": [r.frame for r in own],
                    "y": plain(np.round(values, 4)),
                    "marker": {"color": css_color(i), "size": 7 if used else 10, "symbol": "circle" if used else "x"},
                }
            )
    what = "depth residual, mm RMS" if depth else "residual, px RMS"
    layout = _axes("frame", what)
    layout["xaxis"] |= {"type": "category", "categoryorder": "array", "categoryarray": order, "nticks": 14}
    layout["yaxis"] |= {"type": "log", "tickvals": _LOG_TICKS, "ticktext": [f"{t:g}" for t in _LOG_TICKS]}
    return {"data": traces, "layout": layout}


def image_px(cells: Cells, width: int, height: int, top_px: float) -> tuple[Figure, float]:
    """Residuals over one image: RMS as colour, mean as arrows, and by how much the arrows are lengthened."""
    longest = np.nanmax(np.linalg.norm(cells.mean_px, axis=-1), initial=0.0)
    cell_px = width / len(cells.u_px)
    scale = _ARROW_SHARE * cell_px / longest if longest > 0 else 1.0
    scale = float(f"{scale:.1g}")
    x, y = [], []
    for r, v in enumerate(cells.v_px):
        for c, u in enumerate(cells.u_px):
            du, dv = scale * cells.mean_px[r, c]
            if np.isfinite(du):
                x += [*_arrow(u, du, v, dv)[0], np.nan]
                y += [*_arrow(u, du, v, dv)[1], np.nan]
    arrows = {
        "type": "scatter",
        "mode": "lines",
        "x": plain(np.round(x, 1)),
        "y": plain(np.round(y, 1)),
        "line": {"color": "#222", "width": 1.6},
        "hoverinfo": "skip",
        "showlegend": False,
    }
    heat = _heat(cells, cells.rms_px, "%{z:.3f} px RMS", _SIZES, 0, top_px)
    return {"data": [heat, arrows], "layout": _image_layout(width, height)}, scale


def image_depth(cells: Cells, width: int, height: int, top_mm: float) -> Figure:
    """Mean depth residual over one image, mm."""
    heat = _heat(cells, 1e3 * cells.mean_depth_m, "%{z:+.2f} mm", _SIGNS, -top_mm, top_mm)
    return {"data": [heat], "layout": _image_layout(width, height)}


def distance_depth(bins: Mapping[str, DistanceBins]) -> Figure:
    """Mean depth residual by distance, with the spread of single corners."""
    traces = []
    for i, (name, own) in enumerate(bins.items()):
        if len(own.depth_m):
            spread = {"type": "data", "array": plain(np.round(1e3 * own.sd_depth_m, 3)), "thickness": 1, "width": 3}
            traces.append(_line(name, own.depth_m, 1e3 * own.mean_depth_m, i) | {"error_y": spread})
    return {"data": traces, "layout": _axes("measured depth, m", "depth residual, mm")}


def distance_px(bins: Mapping[str, DistanceBins]) -> Figure:
    """RMS pixel residual by distance."""
    traces = [_line(name, b.depth_m, b.rms_px, i) for i, (name, b) in enumerate(bins.items()) if len(b.depth_m)]
    layout = _axes("measured depth, m", "residual, px RMS")
    layout["yaxis"]["rangemode"] = "tozero"
    return {"data": traces, "layout": layout}


def depth_bias(bias: DepthBias, samples: Mapping[str, Any] | None, left: Residuals | None, index: int) -> Figure:
    """Correction by reported depth: the curve, its standard error, and the data behind it."""
    z = np.linspace(bias.min_m, bias.max_m, 60)
    mm = 1e3 * (bias.correct(z) - z)
    traces = []
    if bias.covariance is not None:
        se = 1e3 * bias.standard_error(z)
        traces.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": "± 1 standard error",
                "x": plain(np.round(np.concatenate([z, z[::-1]]), 4)),
                "y": plain(np.round(np.concatenate([mm + se, (mm - se)[::-1]]), 3)),
                "fill": "toself",
                "fillcolor": "rgba(79, 134, 184, 0.3)",
                "line": {"width": 0},
                "hoverinfo": "skip",
            }
        )
    if left is not None:
        boards = _board_depths(left, bias)
        traces.append(_dots("boards, one dot a view", *boards, "#9a9a9a", 5, "circle"))
    if samples:
        z_m, true_m = np.array(samples["z_m"], float), np.array(samples["z_true_m"], float)
        out = np.array(samples.get("dropped", np.zeros(len(z_m))), bool)
        traces.append(_dots("bias recording", z_m[~out], (true_m - z_m)[~out], css_color(index), 8, "diamond"))
        if out.any():
            traces.append(_dots("left out", z_m[out], (true_m - z_m)[out], css_color(index), 9, "x"))
    traces.append(
        {
            "type": "scatter",
            "mode": "lines",
            "name": "correction",
            "x": plain(np.round(z, 4)),
            "y": plain(np.round(mm, 3)),
            "line": {"color": "#1c4f7c", "width": 2.5},
        }
    )
    return {"data": traces, "layout": _axes("depth as reported, m", "true - reported, mm") | {"height": 320}}


def pair_graph(cameras: Sequence[str], pairs: Sequence[Mapping[str, Any]]) -> Figure:
    """Cameras on a circle, joined by the frames that they share."""
    angle = np.pi / 2 - 2 * np.pi * np.arange(len(cameras)) / max(len(cameras), 1)
    place = dict(zip(cameras, np.round(np.column_stack([np.cos(angle), np.sin(angle)]), 3).tolist(), strict=True))
    most = max([1, *(p["common_frames"] for p in pairs)])
    traces = []
    notes = []
    for p in pairs:
        (ax, ay), (bx, by) = (place[name] for name in p["cameras"])
        if p["common_frames"] == 0:
            continue
        width = 1 + 7 * p["common_frames"] / most
        traces.append(
            {
                "type": "scatter",
                "mode": "lines",
                "x": [ax, bx],
                "y": [ay, by],
                "line": {"width": width, "color": "#9fb8cf"},
                "hoverinfo": "skip",
            }
        )
        at = 0.38  # off the middle, so that crossing edges keep their numbers apart
        notes.append(
            {
                "x": ax + at * (bx - ax),
                "y": ay + at * (by - ay),
                "text": str(p["common_frames"]),
                "showarrow": False,
                "bgcolor": "white",
                "font": {"size": 14},
            }
        )
    x, y = np.array(list(place.values())).T if place else (np.empty(0), np.empty(0))
    nodes = {
        "type": "scatter",
        "mode": "markers+text",
        "x": x.tolist(),
        "y": y.tolist(),
        "text": list(place),
        "textposition": ["top center" if b >= 0 else "bottom center" for b in y],
        "textfont": {"size": 15},
        "cliponaxis": False,
        "marker": {"size": 22, "color": [css_color(i) for i in range(len(place))]},
        "hoverinfo": "text",
    }
    span = {"visible": False, "range": [-1.4, 1.4]}
    layout = {
        "height": 320,
        "showlegend": False,
        "annotations": notes,
        "margin": {"l": 8, "r": 8, "t": 8, "b": 8},
        "xaxis": span,
        "yaxis": span | {"scaleanchor": "x"},
    }
    return {"data": [*traces, nodes], "layout": layout}


def rounds(history: Sequence[Mapping[str, Any]], key: str, what: str, factor: float, cameras: Sequence[str]) -> Figure:
    """One number over the rounds of weights, by camera where it is so."""
    n = np.arange(1.0, len(history) + 1)
    by_camera = isinstance(history[-1].get(key), Mapping)
    series = {name: [row[key].get(name, np.nan) for row in history] for name in cameras} if by_camera else {}
    if not by_camera:
        series = {"all cameras": [row.get(key, np.nan) for row in history]}
    traces = [_line(name, n, factor * np.array(y, float), i) for i, (name, y) in enumerate(series.items())]
    layout = _axes("round", what) | {"showlegend": by_camera}
    layout["xaxis"]["dtick"] = max(1, len(n) // 8)
    return {"data": traces, "layout": layout}


def _arrow(u: float, du: float, v: float, dv: float) -> tuple[list[float], list[float]]:
    """A line with a head of two short strokes."""
    tips = [complex(du, dv) * 0.3 * np.exp(1j * a) for a in (np.pi * 0.85, -np.pi * 0.85)]
    end = complex(u + du, v + dv)
    path = [complex(u, v), end, end + tips[0], end, end + tips[1]]
    return [p.real for p in path], [p.imag for p in path]


def _board_depths(left: Residuals, bias: DepthBias) -> tuple[FloatArray, FloatArray]:
    """Median reported depth and median of true - reported, both metres, of each view with depth."""
    rows = left.select(left.used_depth)
    if not len(rows.frame):
        return np.empty(0), np.empty(0)
    missing = bias.correct(rows.depth_m) - rows.residual_depth_m - rows.depth_m
    groups = [rows.frame == frame for frame in np.unique(rows.frame)]
    return np.array([np.median(rows.depth_m[g]) for g in groups]), np.array([np.median(missing[g]) for g in groups])


def _dots(name: str, z_m: FloatArray, off_m: FloatArray, color: str, size: int, symbol: str) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "markers",
        "name": name,
        "x": plain(np.round(z_m, 4)),
        "y": plain(np.round(1e3 * off_m, 3)),
        "marker": {"color": color, "size": size, "symbol": symbol},
    }


def _line(name: str, x: FloatArray, y: FloatArray, index: int) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "name": name,
        "x": plain(np.round(x, 4)),
        "y": plain(np.round(y, 5)),
        "line": {"color": css_color(index), "width": 1.6},
        "marker": {"size": 5},
    }


def _heat(cells: Cells, z: FloatArray, hover: str, colors: list[Any], low: float, high: float) -> dict[str, Any]:
    return {
        "type": "heatmap",
        "x": cells.u_px.tolist(),
        "y": cells.v_px.tolist(),
        "z": plain(np.round(z, 4)),
        "colorscale": colors,
        "zmin": low,
        "zmax": high,
        "hovertemplate": hover + "<extra></extra>",
        "hoverongaps": False,
        "showscale": False,
    }


def _image_layout(width: int, height: int) -> dict[str, Any]:
    axis = {"showgrid": False, "zeroline": False, "ticks": "", "showticklabels": False}
    return {
        "height": 205,
        "margin": {"l": 2, "r": 2, "t": 4, "b": 4},
        "plot_bgcolor": "#e9ebee",
        "showlegend": False,
        "xaxis": axis | {"range": [0, width], "constrain": "domain"},
        "yaxis": axis | {"range": [height, 0], "scaleanchor": "x", "constrain": "domain"},
    }


def _axes(x: str, y: str) -> dict[str, Any]:
    axis = {"gridcolor": _GRID, "zerolinecolor": "#bbb", "automargin": True}
    return {
        "height": 330,
        "margin": {"l": 56, "r": 12, "t": 8, "b": 48},
        "xaxis": axis | {"title": {"text": x}},
        "yaxis": axis | {"title": {"text": y}},
        "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0},
    }

"""Figures of the report, as plotly's plain mappings {"data": [...], "layout": {...}}."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from rgbd_calib.quality import PairViews
from rgbd_calib.report.numbers import Cells, ViewResidual
from rgbd_calib.report.plots import (
    SIGNS,
    SIZES,
    Figure,
    arrows,
    axes,
    css_color,
    heat,
    image_layout,
    line,
    longest,
    plain,
)
from rgbd_calib.views.coverage import CameraCoverage, CoverageParams

_ARROW_SHARE = 0.9  # of a cell
_LOG_TICKS = [float(f"{m}e{e}") for e in range(-4, 5) for m in (1, 1.5, 2, 3, 5, 7)]


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
    return {"data": traces, "layout": axes("distance of the board", "views") | {"barmode": "group", "height": 300}}


def views(rows: Sequence[ViewResidual], cameras: Sequence[str], depth: bool) -> Figure:
    """RMS of every view, in px or of depth in mm; crosses are views that were left out."""
    order = list(dict.fromkeys(row.frame.replace(" alone: ", " ") for row in rows))
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
                    "x": [r.frame.replace(" alone: ", " ") for r in own],
                    "y": plain(np.round(values, 4)),
                    "marker": {"color": css_color(i), "size": 7 if used else 10, "symbol": "circle" if used else "x"},
                }
            )
    what = "depth residual, mm RMS" if depth else "residual, px RMS"
    layout = axes("frame", what)
    layout["xaxis"] |= {"type": "category", "categoryorder": "array", "categoryarray": order, "nticks": 14}
    layout["yaxis"] |= {"type": "log", "tickvals": _LOG_TICKS, "ticktext": [f"{t:g}" for t in _LOG_TICKS]}
    return {"data": traces, "layout": layout}


def image_px(cells: Cells, width: int, height: int, top_px: float) -> tuple[Figure, float]:
    """Residuals over one image: RMS as colour, mean as arrows, and by how much the arrows are lengthened."""
    scale = longest(cells.mean_px, _ARROW_SHARE * width / len(cells.u_px))
    trace = heat(cells.u_px, cells.v_px, cells.rms_px, "%{z:.3f} px RMS", SIZES, 0, top_px)
    at = np.stack(np.meshgrid(cells.u_px, cells.v_px), axis=-1)
    return {"data": [trace, arrows(at, scale * cells.mean_px)], "layout": image_layout(0, width, 0, height)}, scale


def image_depth(cells: Cells, width: int, height: int, top_mm: float) -> Figure:
    """Mean depth residual over one image, mm."""
    trace = heat(cells.u_px, cells.v_px, 1e3 * cells.mean_depth_m, "%{z:+.2f} mm", SIGNS, -top_mm, top_mm)
    return {"data": [trace], "layout": image_layout(0, width, 0, height)}


def pair_graph(cameras: Sequence[str], pairs: Sequence[PairViews]) -> Figure:
    """Cameras on a circle, joined by the frames that they share."""
    angle = np.pi / 2 - 2 * np.pi * np.arange(len(cameras)) / max(len(cameras), 1)
    place = dict(zip(cameras, np.round(np.column_stack([np.cos(angle), np.sin(angle)]), 3).tolist(), strict=True))
    most = max([1, *(p.common_frames for p in pairs)])
    traces = []
    notes = []
    for p in pairs:
        (ax, ay), (bx, by) = (place[name] for name in p.cameras)
        if p.common_frames == 0:
            continue
        width = 1 + 7 * p.common_frames / most
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
                "text": str(p.common_frames),
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


def rounds(
    history: Sequence[Mapping[str, float] | float | None], what: str, factor: float, cameras: Sequence[str]
) -> Figure:
    """One number over the rounds of weights, by camera where it is so."""
    n = np.arange(1.0, len(history) + 1)
    by_camera = isinstance(history[-1], Mapping)
    series = {"all cameras": [np.nan if isinstance(own, Mapping) or own is None else own for own in history]}
    if by_camera:
        series = {c: [own.get(c, np.nan) for own in history if isinstance(own, Mapping)] for c in cameras}
    traces = [line(name, n, factor * np.array(y, float), i) for i, (name, y) in enumerate(series.items())]
    layout = axes("round", what) | {"showlegend": by_camera}
    layout["xaxis"]["dtick"] = max(1, len(n) // 8)
    return {"data": traces, "layout": layout}

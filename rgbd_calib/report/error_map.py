"""The expected error over the working volume: slices of its grid, and how much of the volume is below which error.

Axes are those of the reference camera: x right, y down, z away from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.quality import Quality
from rgbd_calib.report.plots import Figure, axes, css_color, plain
from rgbd_calib.types import Rig

MAX_SIDE = 40
"""Places along an axis; more are no grid along the reference camera's axes."""
SLICES = 3
LIMITS_MM = (0.5, 1.0, 2.0, 5.0, 10.0)
_STEPS_MM = [float(f"{m}e{e}") for e in range(-3, 5) for m in (1, 2, 5)]
TOP_MEDIANS = 4.0
"""Colours end at so many medians at most."""
_LINES = 10
"""Contour lines at most."""


@dataclass(frozen=True)
class ErrorGrid:
    """Expected error on a grid along the axes of the reference camera."""

    x_m: FloatArray
    y_m: FloatArray
    z_m: FloatArray
    error_mm: FloatArray
    """(len(x), len(y), len(z)); NaN where no two cameras see the place."""

    @property
    def top_mm(self) -> float:
        """What colours end at."""
        return top_mm(self.error_mm)


def top_mm(error_mm: FloatArray) -> float:
    """What colours end at: few places are worse, and a few of enormous error do not make all others look good."""
    error_mm = error_mm[np.isfinite(error_mm)]
    return min(float(np.percentile(error_mm, 98)), TOP_MEDIANS * float(np.median(error_mm))) if len(error_mm) else 1.0


def points_of(quality: Quality) -> tuple[FloatArray, FloatArray]:
    """Points (n, 3), metres, in the reference camera's frame, and their expected error (n,), mm; empty where not known."""
    expected = quality.expected_alignment
    if expected is None or expected.grid is None:
        return np.empty((0, 3)), np.empty(0)
    return expected.grid.points_in_reference_m.reshape(-1, 3), expected.grid.error_mm


def grid_of(quality: Quality) -> ErrorGrid | None:
    """The grid in a rig file; None where it has none."""
    points_m, error_mm = points_of(quality)
    if not len(points_m):
        return None
    (x, i), (y, j), (z, k) = (np.unique(points_m[:, axis], return_inverse=True) for axis in range(3))
    if max(len(x), len(y), len(z)) > MAX_SIDE:
        return None
    error = np.full((len(x), len(y), len(z)), np.nan)
    error[i, j, k] = error_mm
    return ErrorGrid(x, y, z, error)


def shares(grid: ErrorGrid) -> list[tuple[float, float]]:
    """(limit in mm, share of the volume at or below it), from the first that some of it keeps to the first that all of it does."""
    error = grid.error_mm[np.isfinite(grid.error_mm)]
    out = [(limit, float(np.mean(error <= limit))) for limit in LIMITS_MM if error.min() <= limit]
    whole = [i for i, (_, share) in enumerate(out) if share == 1.0]
    return out[: whole[0] + 1] if whole else out


def by_distance(grid: ErrorGrid) -> list[dict[str, float]]:
    """Mean, best and worst expected error, mm, and share at most 1 mm, for each distance of the grid from the reference."""
    rows = []
    for k, z_m in enumerate(grid.z_m):
        error = grid.error_mm[:, :, k][np.isfinite(grid.error_mm[:, :, k])]
        if len(error):
            rows.append(
                {
                    "z_m": float(z_m),
                    "mean_mm": float(error.mean()),
                    "best_mm": float(error.min()),
                    "worst_mm": float(error.max()),
                    "below_1": float(np.mean(error <= 1.0)),
                }
            )
    return rows


def from_above(grid: ErrorGrid, rig: Rig) -> list[tuple[float, Figure]]:
    """(height y in m, figure) of slices seen from above, with the cameras in them."""
    T_reference_world = se3.inverse(rig.cameras[rig.reference].T_world_color)
    at_m = se3.transform(T_reference_world, np.array([own.T_world_color[:3, 3] for own in rig.cameras.values()]))
    cameras = {
        "type": "scatter",
        "mode": "markers+text",
        "x": plain(np.round(at_m[:, 0], 3)),
        "y": plain(np.round(at_m[:, 2], 3)),
        "text": list(rig.cameras),
        "textposition": "top center",
        "marker": {"size": 11, "symbol": "triangle-up", "color": [css_color(i) for i in range(len(at_m))]},
        "hoverinfo": "text",
    }
    out = []
    for j in _chosen(grid.error_mm, 1):
        layout = axes("x, m", "z, m") | {"showlegend": False, "height": 300}
        layout["yaxis"] |= {"scaleanchor": "x"}
        traces = [_contour(grid, grid.x_m, grid.z_m, grid.error_mm[:, j, :].T), cameras]
        out.append((float(grid.y_m[j]), {"data": traces, "layout": layout}))
    return out


def across(grid: ErrorGrid) -> list[tuple[float, Figure]]:
    """(distance z in m, figure) of slices across the reference camera's view."""
    out = []
    for k in _chosen(grid.error_mm, 2):
        layout = axes("x, m", "y (down), m") | {"showlegend": False, "height": 260}
        layout["yaxis"] |= {"scaleanchor": "x", "autorange": "reversed"}
        figure = {"data": [_contour(grid, grid.x_m, grid.y_m, grid.error_mm[:, :, k].T)], "layout": layout}
        out.append((float(grid.z_m[k]), figure))
    return out


def _chosen(error_mm: FloatArray, axis: int) -> list[int]:
    """Slices spread over an axis, among those that hold something in two rows and two columns at least."""
    filled = []
    for i in range(error_mm.shape[axis]):
        there = np.isfinite(np.take(error_mm, i, axis))
        if there.any(axis=0).sum() > 1 and there.any(axis=1).sum() > 1:
            filled.append(i)
    if len(filled) <= SLICES:
        return filled
    inner = np.linspace(0, len(filled) - 1, SLICES + 2)[1:-1]
    return [filled[i] for i in dict.fromkeys(round(i) for i in inner)]


def _contour(grid: ErrorGrid, x: FloatArray, y: FloatArray, z: FloatArray) -> dict[str, Any]:
    top = grid.top_mm
    step = next(s for s in _STEPS_MM if top / s <= _LINES)
    return {
        "type": "contour",
        "x": plain(np.round(x, 3)),
        "y": plain(np.round(y, 3)),
        "z": plain(np.round(z, 3)),
        "zmin": 0,
        "zmax": top,
        "colorscale": "Viridis",
        "reversescale": True,
        "contours": {"coloring": "heatmap", "showlabels": True, "start": step, "end": step * _LINES, "size": step},
        "line": {"color": "rgba(0,0,0,0.45)", "width": 1},
        "connectgaps": False,
        "hovertemplate": "%{z:.2f} mm<extra></extra>",
        "colorbar": {"title": {"text": "mm", "side": "top"}, "thickness": 10, "outlinewidth": 0},
    }

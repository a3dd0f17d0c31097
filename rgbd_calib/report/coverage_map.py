"""Coverage of the image and the range together: where in the image, at which distances, the board was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.report.plots import Figure
from rgbd_calib.types import IntArray
from rgbd_calib.views.coverage import CoverageParams, PlacedView, region_names

BANDS = ("near", "middle", "far")
_COUNTS = [[0, "#f3d9d3"], [0.001, "#eef3f7"], [1, "#4f86b8"]]


@dataclass(frozen=True)
class RangeCoverage:
    """Views by region of one camera's image and by distance of the board."""

    edges_m: FloatArray
    """(bands + 1,), the same for all cameras of a rig."""
    counts: IntArray
    """(bands, rows, columns)."""

    @property
    def empty(self) -> list[str]:
        """Where nothing was filmed, in words, by band."""
        out = []
        for name, low, high, own in zip(BANDS, self.edges_m[:-1], self.edges_m[1:], self.counts, strict=True):
            where = f"{name} ({low:.1f} to {high:.1f} m)"
            if not own.any():
                out.append(f"{where}: no view")
            elif not own.all():
                out.append(
                    f"{where}: {int((own == 0).sum())} of {own.size} regions empty, such as {region_names(own == 0)}"
                )
        return out


def range_coverage(placed: Sequence[PlacedView], cameras: Sequence[str]) -> dict[str, RangeCoverage]:
    """By camera; the distances of all views of the rig, split in three equal bands. Empty where no distance is known."""
    distances_m = np.array([v.distance_m for v in placed if np.isfinite(v.distance_m)])
    if not len(distances_m):
        return {}
    edges_m = np.linspace(distances_m.min(), distances_m.max() + 1e-6, len(BANDS) + 1)
    params = CoverageParams()
    out = {}
    for name in cameras:
        counts = np.zeros((len(BANDS), params.region_rows, params.region_columns), int)
        for view in placed:
            if view.camera == name and np.isfinite(view.distance_m):
                band = min(int(np.searchsorted(edges_m, view.distance_m, side="right")) - 1, len(BANDS) - 1)
                counts[max(band, 0)] += view.regions
        out[name] = RangeCoverage(edges_m, counts)
    return out


def figure(own: RangeCoverage) -> Figure:
    """Three maps of one image, near to far, in one row."""
    top = max(int(own.counts.max()), 1)
    traces, notes = [], []
    layout: Figure = {"height": 150, "margin": {"l": 4, "r": 4, "t": 22, "b": 4}, "showlegend": False}
    gap, share = 0.02, 1 / len(BANDS)
    for i, counts in enumerate(own.counts):
        n = "" if i == 0 else str(i + 1)
        traces.append(
            {
                "type": "heatmap",
                "z": counts.tolist(),
                "text": counts.tolist(),
                "texttemplate": "%{text}",
                "hovertemplate": "%{z} views<extra></extra>",
                "colorscale": _COUNTS,
                "zmin": 0,
                "zmax": top,
                "showscale": False,
                "xgap": 2,
                "ygap": 2,
                "xaxis": f"x{n}",
                "yaxis": f"y{n}",
            }
        )
        domain = [i * share + gap / 2, (i + 1) * share - gap / 2]
        layout[f"xaxis{n}"] = {"visible": False, "domain": domain}
        layout[f"yaxis{n}"] = {"visible": False, "autorange": "reversed", "anchor": f"x{n}"}
        text = f"{own.edges_m[i]:.1f}-{own.edges_m[i + 1]:.1f} m"
        notes.append(
            {
                "x": sum(domain) / 2,
                "y": 1,
                "xref": "paper",
                "yref": "paper",
                "xanchor": "center",
                "yanchor": "bottom",
                "text": text,
                "showarrow": False,
            }
        )
    return {"data": traces, "layout": layout | {"annotations": notes}}

"""Coverage of the image and the range together: where in the image, at which distances, the board was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.report.plots import Figure
from rgbd_calib.types import IntArray
from rgbd_calib.views.coverage import CoverageParams, ViewCoverage, region_names

BANDS = ("near", "middle", "far")
_COUNTS = [[0, "#f3d9d3"], [0.001, "#eef3f7"], [1, "#4f86b8"]]


@dataclass(frozen=True)
class RangeCoverage:
    """Views by region of one camera's image and by distance of the board."""

    edges_m: FloatArray
    """(bands + 1,), the same for all cameras of a rig; NaN where no distance is known, in one band."""
    counts: IntArray
    """(bands, rows, columns)."""

    @property
    def labels(self) -> list[str]:
        """Of the bands."""
        if len(self.counts) == 1:
            return ["any distance"]
        pairs = zip(BANDS, self.edges_m[:-1], self.edges_m[1:], strict=True)
        return [f"{name}, {low:.1f}-{high:.1f} m" for name, low, high in pairs]

    @property
    def empty(self) -> list[str]:
        """Where nothing was filmed, in words, by band."""
        out = []
        for where, own in zip(self.labels, self.counts, strict=True):
            if not own.any():
                out.append(f"{where}: no view")
            elif not own.all():
                out.append(
                    f"{where}: {int((own == 0).sum())} of {own.size} regions empty, such as {region_names(own == 0)}"
                )
        return out


def range_coverage(placed: Sequence[ViewCoverage], cameras: Sequence[str]) -> dict[str, RangeCoverage]:
    """By camera; the distances of all views of the rig, split in three equal bands; all views in one where no distance is known."""
    distances_m = np.array([v.distance_m for v in placed if np.isfinite(v.distance_m)])
    edges_m = np.full(2, np.nan)
    if len(distances_m):
        edges_m = np.linspace(distances_m.min(), distances_m.max() + 1e-6, len(BANDS) + 1)
    params = CoverageParams()
    out = {}
    for name in cameras:
        counts = np.zeros((len(edges_m) - 1, params.region_rows, params.region_columns), int)
        for view in placed:
            if view.camera == name and (np.isfinite(view.distance_m) or not len(distances_m)):
                counts[np.searchsorted(edges_m[1:-1], view.distance_m, side="right")] += view.regions
        out[name] = RangeCoverage(edges_m, counts)
    return out


def figure(own: RangeCoverage) -> Figure:
    """Maps of one image, near to far, in one row."""
    top = max(int(own.counts.max()), 1)
    traces, notes = [], []
    layout: Figure = {"height": 150, "margin": {"l": 4, "r": 4, "t": 22, "b": 4}, "showlegend": False}
    gap, share = 0.02, 1 / len(own.counts)
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
        notes.append(
            {
                "x": sum(domain) / 2,
                "y": 1,
                "xref": "paper",
                "yref": "paper",
                "xanchor": "center",
                "yanchor": "bottom",
                "text": own.labels[i],
                "font": {"size": 11},
                "showarrow": False,
            }
        )
    return {"data": traces, "layout": layout | {"annotations": notes}}

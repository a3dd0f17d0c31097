"""Coverage of the image and the range together: where in the image, at which distances, the board was.

A report and the preview of a capture show the same numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import IntArray
from rgbd_calib.views.coverage import CoverageParams, ViewCoverage, region_names

BANDS = ("near", "middle", "far")
_NARROWEST_M = 0.1
"""Of a band; narrower ones have one name in labels with a decimal."""


@dataclass(frozen=True)
class RangeCoverage:
    """Views by region of one camera's image and by distance of the board."""

    edges_m: FloatArray
    """(bands + 1,), the same for all cameras of a rig; one band where the distances are alike, with NaN where none is known."""
    counts: IntArray
    """(bands, rows, columns)."""

    @property
    def labels(self) -> list[str]:
        """Of the bands."""
        if len(self.counts) == 1:
            low, high = self.edges_m
            return ["any distance" if np.isnan(low) else f"{low:.1f}-{high:.1f} m"]
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
    """By camera; the distances of all views of the rig, split in three equal bands; one band where they are alike or unknown."""
    distances_m = np.array([v.distance_m for v in placed if np.isfinite(v.distance_m)])
    edges_m = np.full(2, np.nan)
    if len(distances_m):
        bands = len(BANDS) if np.ptp(distances_m) >= len(BANDS) * _NARROWEST_M else 1
        edges_m = np.linspace(distances_m.min(), distances_m.max() + 1e-6, bands + 1)
    params = CoverageParams()
    out = {}
    for name in cameras:
        counts = np.zeros((len(edges_m) - 1, params.region_rows, params.region_columns), int)
        for view in placed:
            if view.camera == name and (np.isfinite(view.distance_m) or not len(distances_m)):
                counts[np.searchsorted(edges_m[1:-1], view.distance_m, side="right")] += view.regions
        out[name] = RangeCoverage(edges_m, counts)
    return out

"""Measured corners that do not lie on their board's plane are dropped: RANSAC planes (the paper, section 7)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rgbd_calib.geometry import plane
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.types import BoardView, DepthBias


@dataclass(frozen=True)
class PlaneFilterParams:
    threshold_per_m: float = 0.005
    """A corner is off the plane where it is farther from it than this times z^2 (0.5 % of z at 1 m, 20 mm at 2 m): three
    sigma of one pixel of a structured-light sensor, and far more of the mean that a corner rests on."""
    min_inlier_share: float = 0.5
    """With fewer corners on the plane the view's depth is dropped whole: it shows something else."""


@dataclass(frozen=True)
class PlaneFilterResult:
    views: tuple[BoardView, ...]
    """The same views; the depth of dropped corners is NaN now."""
    dropped_corners: int
    dropped_views: tuple[tuple[str, str], ...]
    """(camera, frame) of views whose depth was dropped whole."""


def filter_planes(
    views: Sequence[BoardView],
    intrinsics: Mapping[str, Intrinsics],
    biases: Mapping[str, DepthBias],
    params: PlaneFilterParams | None = None,
    seed: int = 0,
) -> PlaneFilterResult:
    """Drop measured corners off the plane of their view; views without depth pass."""
    params = params or PlaneFilterParams()
    rng = np.random.default_rng(seed)
    out, dropped_corners, dropped_views = [], 0, []
    for view in views:
        measured = np.isfinite(view.depth_m)
        if measured.sum() < 4:
            out.append(view)
            continue
        bias = biases.get(view.camera)
        z_m = view.depth_m[measured] if bias is None else bias.correct(view.depth_m[measured])
        points_m = intrinsics[view.camera].unproject(view.corners_px[measured], z_m)
        inliers = plane.ransac(points_m, params.threshold_per_m * z_m**2, rng)[2]
        if inliers.mean() < params.min_inlier_share:
            inliers = np.zeros_like(inliers)
            dropped_views.append((view.camera, view.frame))
        dropped_corners += int((~inliers).sum())
        depth_m = view.depth_m.copy()
        depth_m[np.flatnonzero(measured)[~inliers]] = np.nan
        out.append(replace(view, depth_m=depth_m))
    return PlaneFilterResult(tuple(out), dropped_corners, tuple(dropped_views))

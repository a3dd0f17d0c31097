"""Residuals in groups: by camera, by view, over the image, over distance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.residuals import Residuals
from rgbd_calib.io.rig import board_in
from rgbd_calib.trust.verdict import Verdict, judge, limits_in
from rgbd_calib.types import Board, BoardView, Rig
from rgbd_calib.views.coverage import Coverage, CoverageParams, measure_coverage

CELLS = (8, 6)
"""Columns and rows of the cells of an image."""
BINS = 8
MIN_IN_CELL = 3


def rms(values: FloatArray) -> float:
    """Root mean square of what is finite, NaN where nothing is."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else float("nan")


@dataclass(frozen=True)
class ViewResidual:
    """One view of the board."""

    camera: str
    frame: str
    rms_px: float
    """Of a pixel coordinate."""
    rms_depth_m: float
    used_pixel: bool
    used_depth: bool


def by_view(r: Residuals) -> list[ViewResidual]:
    """RMS of every view; of the observations that were used, or of all where none were."""
    keys, index = np.unique(np.char.add(np.char.add(r.camera, "\t"), r.frame), return_inverse=True)
    out = []
    for i, key in enumerate(keys):
        own = r.select(index == i)
        camera, frame = str(key).split("\t")
        pixel = own.used_pixel if own.used_pixel.any() else np.ones(len(own.camera), bool)
        depth = own.used_depth if own.used_depth.any() else np.ones(len(own.camera), bool)
        left = rms(own.residual_px[pixel]), rms(own.residual_depth_m[depth])
        out.append(ViewResidual(camera, frame, *left, bool(own.used_pixel.any()), bool(own.used_depth.any())))
    return sorted(out, key=lambda view: (" alone: " in view.frame, view.frame, view.camera))


@dataclass(frozen=True)
class Cells:
    """One camera's residuals over its image; arrays (rows, columns), NaN in cells with too few."""

    u_px: FloatArray
    """(columns,) middles of the cells."""
    v_px: FloatArray
    count: np.ndarray
    mean_px: FloatArray
    """(rows, columns, 2)."""
    rms_px: FloatArray
    mean_depth_m: FloatArray


def over_image(r: Residuals, width: int, height: int) -> Cells:
    """Residuals of one camera in cells of its image, of what was used."""
    columns, rows = CELLS
    at = np.clip((r.pixels_px / [width, height] * CELLS).astype(int), 0, np.array(CELLS) - 1)
    cell = at[:, 1] * columns + at[:, 0]
    pixel = r.used_pixel & np.isfinite(r.residual_px).all(axis=1)
    depth = r.used_depth & np.isfinite(r.residual_depth_m)

    def mean(values: FloatArray, which: np.ndarray) -> FloatArray:
        n = np.bincount(cell[which], minlength=columns * rows)
        total = np.bincount(cell[which], values[which], minlength=columns * rows)
        return np.where(n >= MIN_IN_CELL, total / np.maximum(n, 1), np.nan).reshape(rows, columns)

    means = [mean(r.residual_px[:, k], pixel) for k in range(2)]
    square = mean((r.residual_px**2).sum(axis=1) / 2, pixel)
    return Cells(
        (np.arange(columns) + 0.5) * width / columns,
        (np.arange(rows) + 0.5) * height / rows,
        np.bincount(cell, minlength=columns * rows).reshape(rows, columns),
        np.stack(means, axis=-1),
        np.sqrt(square),
        mean(r.residual_depth_m, depth),
    )


@dataclass(frozen=True)
class DistanceBins:
    """One camera's residuals by measured depth."""

    depth_m: FloatArray
    """Middles of the bins that hold something."""
    rms_px: FloatArray
    mean_depth_m: FloatArray
    sd_depth_m: FloatArray


def over_distance(r: Residuals) -> DistanceBins:
    """Residuals of one camera in bins of depth, of what was used."""
    depth = r.used_depth & np.isfinite(r.residual_depth_m)
    if not depth.any():
        return DistanceBins(*np.empty((4, 0)))
    wanted = float(np.ptp(r.depth_m[depth])) / BINS
    width_m = next((step for step in (0.05, 0.1, 0.25, 0.5) if step >= wanted), 1.0)
    bins = np.floor(r.depth_m / width_m)
    rows = []
    for b in np.unique(bins[depth]):
        mine = depth & (bins == b)
        if mine.sum() >= MIN_IN_CELL:
            z = r.residual_depth_m[mine]
            rows.append(((b + 0.5) * width_m, rms(r.residual_px[mine & r.used_pixel]), z.mean(), z.std()))
    return DistanceBins(*np.array(rows, float).reshape(-1, 4).T)


def coverage_of(r: Residuals, board: Board, intrinsics: Mapping[str, Intrinsics], judge_cameras: bool) -> Coverage:
    """Coverage by the views that were used; depth cameras go with their colour cameras."""
    views = []
    r = r.select(np.isin(r.camera, list(intrinsics)))
    keys = np.char.add(np.char.add(r.camera, "\t"), r.frame)
    for key in np.unique(keys[r.used_pixel]):
        own = r.select((keys == key) & r.used_pixel)
        views.append(
            BoardView(
                str(own.camera[0]),
                str(own.frame[0]),
                own.feature.astype(int),
                own.pixels_px,
                own.depth_m,
                np.isfinite(own.depth_m).astype(int),
            )
        )
    sizes = {name: (own.width, own.height) for name, own in intrinsics.items()}
    params = CoverageParams(judge_cameras=judge_cameras)
    return measure_coverage(views, board, sizes, dict(intrinsics), params)


def coverage_of_rig(rig: Rig, residuals: Residuals | None) -> Coverage | None:
    """Coverage by the views that a rig was calibrated from; None where they, or the board, are not known."""
    board = board_in(rig.quality)
    if residuals is None or board is None:
        return None
    lenses = {name: own.intrinsics for name, own in rig.cameras.items()}
    return coverage_of(residuals, board, lenses, "own views" in str(rig.provenance.get("intrinsics", "")))


def verdict_of(rig: Rig, residuals: Residuals | None) -> Verdict:
    """Whether to trust a rig: the same in the terminal, in Python and in the report."""
    coverage = coverage_of_rig(rig, residuals)
    return judge(rig.quality, coverage.missing if coverage else (), depth_noise_mm(rig), limits_in(rig.provenance))


def depth_noise_mm(rig: Rig) -> float | None:
    """RMS of what is left of a corner's depth, over the cameras that have it."""
    left = [own.statistics["depth_rms_m"] for own in rig.cameras.values() if own.statistics.get("depth_rms_m")]
    return 1e3 * float(np.sqrt(np.mean(np.square(left)))) if left else None


def camera_table(r: Residuals, statistics: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row for each camera: counts and RMS of what was used."""
    rows = []
    for name in statistics:
        own = r.of(name)
        views = {str(f) for f in own.frame[own.used_pixel]}
        rows.append(
            {
                "camera": name,
                "views": len(views),
                "corners": int(own.used_pixel.sum()),
                "corners_left_out": int((~own.used_pixel).sum()),
                "rms_px": rms(own.residual_px[own.used_pixel]),
                "depths": int(own.used_depth.sum()),
                "depths_left_out": int((~own.used_depth & np.isfinite(own.depth_m)).sum()),
                "rms_mm": 1e3 * rms(own.residual_depth_m[own.used_depth]),
            }
        )
    return rows

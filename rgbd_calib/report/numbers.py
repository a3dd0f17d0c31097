"""Residuals in groups: by camera, by view, over the image; coverage and verdict from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.residuals import Residuals
from rgbd_calib.trust.verdict import Verdict, judge, limits_in
from rgbd_calib.types import Board, BoardView, Rig
from rgbd_calib.views.coverage import Coverage, CoverageParams, ViewCoverage, place_view, summarize_coverage

CELLS = (8, 6)
"""Columns and rows of the cells of an image."""
MIN_IN_CELL = 3
DEPTH = "/depth"
"""After a camera's name: its depth camera, where that has a geometry of its own, in the table of residuals."""


def rms(values: FloatArray) -> float:
    """Root mean square of what is finite, NaN where nothing is."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else float("nan")


@dataclass(frozen=True)
class Sensor:
    """A camera of the table of residuals: a colour camera, or the depth camera beside it."""

    name: str
    camera: str
    """Of the rig."""
    intrinsics: Intrinsics
    T_world_sensor: FloatArray
    """(4, 4)."""


def sensors_of(rig: Rig, r: Residuals | None) -> list[Sensor]:
    """The rig's cameras, and then the depth cameras that have residuals of their own."""
    out = [Sensor(name, name, own.intrinsics, own.T_world_color) for name, own in rig.cameras.items()]
    there = set() if r is None else set(r.camera.tolist())
    for name, own in rig.cameras.items():
        if own.depth_camera is not None and name + DEPTH in there:
            T = own.T_world_color @ own.depth_camera.T_color_depth
            out.append(Sensor(name + DEPTH, name, own.depth_camera.intrinsics, T))
    return out


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


def placed_views(r: Residuals, board: Board, intrinsics: Mapping[str, Intrinsics]) -> list[ViewCoverage]:
    """Where each view that was used has the board; of the cameras in `intrinsics`."""
    sizes = {name: (own.width, own.height) for name, own in intrinsics.items()}
    out = []
    beside = np.char.endswith(r.camera, DEPTH)  # its corners may be predicted, where only depth is used
    r = r.select(np.isin(r.camera, list(intrinsics)) & (r.used_pixel | (beside & r.used_depth)))
    order = np.lexsort([r.frame, r.camera])
    keys = np.char.add(np.char.add(r.camera, "\t"), r.frame)[order]
    starts = np.flatnonzero(np.append(True, keys[1:] != keys[:-1])) if len(keys) else np.empty(0, int)
    for rows in np.split(order, starts[1:]) if len(keys) else []:
        own = r.select(rows)
        name, ids = str(own.camera[0]), own.feature.astype(int)
        depth = np.isfinite(own.depth_m).astype(int)
        view = BoardView(name, str(own.frame[0]), ids, own.pixels_px, own.depth_m, depth)
        out.append(place_view(view, board, sizes[name], intrinsics[name]))
    return out


def coverage_of_rig(rig: Rig, placed: Sequence[ViewCoverage]) -> Coverage:
    """Coverage by the views that a rig was calibrated from; depth cameras go with their colour cameras."""
    judge_cameras = "own views" in str(rig.provenance.get("intrinsics", ""))
    mine = [view for view in placed if view.camera in rig.cameras]
    return summarize_coverage(mine, tuple(rig.cameras), CoverageParams(judge_cameras=judge_cameras))


def placed_views_of_rig(rig: Rig, residuals: Residuals | None) -> list[ViewCoverage] | None:
    """None where the views, or the board, are not known."""
    board = rig.quality.board
    if residuals is None or board is None:
        return None
    lenses = {own.name: own.intrinsics for own in sensors_of(rig, residuals)}
    return placed_views(residuals, board, lenses)


def verdict_of(rig: Rig, residuals: Residuals | None) -> Verdict:
    """Whether to trust a rig: the same in the terminal, in Python and in the report."""
    placed = placed_views_of_rig(rig, residuals)
    missing = coverage_of_rig(rig, placed).missing if placed is not None else ()
    return judge(rig.quality, missing, depth_noise_mm(rig), limits_in(rig.provenance))


def depth_noise_mm(rig: Rig) -> float | None:
    """RMS of what is left of a corner's depth, over the cameras that have it."""
    left = [rms for own in rig.cameras.values() if (rms := own.statistics.depth_rms_m)]
    return 1e3 * float(np.sqrt(np.mean(np.square(left)))) if left else None


def camera_table(r: Residuals, names: Sequence[str]) -> list[dict[str, Any]]:
    """One row for each camera: counts and RMS of what was used."""
    rows = []
    for name in names:
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

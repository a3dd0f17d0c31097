"""The board as it was printed: where its corners truly are, against where they were meant to be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.report.plots import SIGNS, Figure, arrows, axes, heat, longest, plain, scale_bar
from rgbd_calib.types import Board


@dataclass(frozen=True)
class PrintMap:
    """One face of a board."""

    face: str
    places_mm: FloatArray
    """(n, 2), of the corners as designed."""
    offset_mm: FloatArray
    """(n, 2), true less designed, without turn and shift of the sheet: they change nothing."""
    local_mm: FloatArray
    """(n, 2), of it, what is neither aspect, shear nor scale."""
    height_mm: FloatArray
    """(n,), out of the best plane, into the board."""
    sd_mm: FloatArray | None
    """(n, 3), standard deviations; None where they are not known."""
    aspect_percent: float
    """Columns against rows: positive where the print is wider along its columns."""
    shear_deg: float
    """From square, of the angle between columns and rows."""

    @property
    def mean_sd_mm(self) -> tuple[float, float] | None:
        """Of a corner in the plane of the sheet, and of its height."""
        if self.sd_mm is None:
            return None
        return float(self.sd_mm[:, :2].mean()), float(self.sd_mm[:, 2].mean())

    @property
    def determined(self) -> bool:
        """False where its corners are less sure than their offsets are large: the recording did not show this face."""
        if self.sd_mm is None:
            return True
        return float(np.sqrt(np.mean(self.sd_mm[:, :2] ** 2))) < float(np.sqrt(np.mean(self.offset_mm**2)))


def sheets_of(board: Board) -> list[PrintMap]:
    """Front and back as far as the board's shape is known."""
    if board.shape is None:
        return []
    own = board.shape
    faces = [("front", own.front_m, own.front_sd_m), ("back", own.back_m, own.back_sd_m)]
    return [_sheet(board, face, points, sd) for face, points, sd in faces if points is not None]


def _sheet(board: Board, face: str, points_m: FloatArray, sd_m: FloatArray | None) -> PrintMap:
    designed = 1e3 * board.square_m * board.grid
    true = 1e3 * points_m[:, :2]
    p, q = designed - designed.mean(axis=0), true - true.mean(axis=0)
    U, _, Vt = np.linalg.svd(q.T @ p)
    turned = q @ (U @ np.diag([1.0, np.linalg.det(U @ Vt)]) @ Vt)  # back into the design's axes: rows times R
    A = np.linalg.lstsq(p, turned, rcond=None)[0].T  # turned = A p + local
    flat = np.column_stack([designed, np.ones(len(designed))])
    height = 1e3 * points_m[:, 2]
    return PrintMap(
        face,
        designed,
        turned - p,
        turned - p @ A.T,
        height - flat @ np.linalg.lstsq(flat, height, rcond=None)[0],
        None if sd_m is None else 1e3 * sd_m,
        100 * float(np.hypot(*A[:, 0]) / np.hypot(*A[:, 1]) - 1),
        float(np.degrees(A[0, 1] + A[1, 0])),
    )


def figure(sheet: PrintMap, square_mm: float) -> tuple[Figure, float]:
    """Arrows from the designed corners to the true ones, lengthened, and by how much; bars are standard deviations, as long."""
    scale = longest(sheet.offset_mm, 0.8 * square_mm)
    tips = sheet.places_mm + scale * sheet.offset_mm
    grid = {
        "type": "scatter",
        "mode": "markers",
        "x": plain(np.round(sheet.places_mm[:, 0], 2)),
        "y": plain(np.round(sheet.places_mm[:, 1], 2)),
        "marker": {"color": "#8a8a8a", "size": 4},
        "hoverinfo": "skip",
    }
    ends = {
        "type": "scatter",
        "mode": "markers",
        "x": plain(np.round(tips[:, 0], 2)),
        "y": plain(np.round(tips[:, 1], 2)),
        "marker": {"color": "#c2412d", "size": 3},
        "text": [f"{x:+.3f}, {y:+.3f} mm" for x, y in sheet.offset_mm],
        "hovertemplate": "%{text}<extra></extra>",
    }
    if sheet.sd_mm is not None:
        for k, key in enumerate(("error_x", "error_y")):
            bars = plain(np.round(scale * sheet.sd_mm[:, k], 3))
            ends[key] = {"type": "data", "array": bars, "thickness": 1.5, "width": 2, "color": "#c2412d"}
    lines = arrows(sheet.places_mm, scale * sheet.offset_mm)
    return {"data": [grid, lines, ends], "layout": _layout()}, scale


def bow(sheet: PrintMap, board: Board) -> Figure:
    """Height of the corners over their best plane, mm."""
    z = sheet.height_mm.reshape(board.rows, board.cols)
    x, y = sheet.places_mm[: board.cols, 0], sheet.places_mm[:: board.cols, 1]
    top = max(float(np.abs(z).max()), 1e-3)
    trace = heat(x, y, z, "%{z:+.2f} mm", SIGNS, -top, top) | scale_bar("height, mm")
    return {"data": [trace], "layout": _layout()}


def _layout() -> Figure:
    layout = axes("along the columns, mm", "along the rows, mm") | {"height": 300, "showlegend": False}
    layout["yaxis"] |= {"scaleanchor": "x", "autorange": "reversed"}
    return layout

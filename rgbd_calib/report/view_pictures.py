"""Single views of the board, as the camera saw them: corners, residuals as arrows, and what the depth errs by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.residuals import Residuals
from rgbd_calib.report.html import jpeg
from rgbd_calib.report.numbers import Sensor, ViewResidual, by_view, rms
from rgbd_calib.report.plots import SIGNS, Figure, arrows, heat, image_layout, longest, plain, scale_bar
from rgbd_calib.types import Board

MARGIN = 0.25
"""Around the board, as share of its size in the image."""
WIDEST_PX = 560
"""Of a picture in the page."""
CELLS = 32
"""Of depth, across a picture."""
FAR_OFF_M = 0.1
"""Depth that is farther off is not of the board: something is before it."""
MIN_CORNERS = 4
_ARROW_SHARE = 1.2  # 95th percentile of the arrows, in squares of the board


@dataclass(frozen=True)
class Chosen:
    """A view that is shown, and why."""

    view: ViewResidual
    why: str
    """worst, best or left out."""


@dataclass(frozen=True)
class ViewPicture:
    """One view; pixels are those of the whole image."""

    chosen: Chosen
    left: Residuals
    """Its rows."""
    image: np.ndarray
    """(h, w, 3), uint8, R G B, a part of the image."""
    corner_px: tuple[int, int]
    """u, v of the first pixel of that part."""
    depth: DepthCells | None
    """None where there is no depth, or no board to compare it with."""


@dataclass(frozen=True)
class DepthCells:
    """What depth on the board errs by, in cells of a picture."""

    u_px: FloatArray
    v_px: FloatArray
    error_mm: FloatArray
    """(len(v), len(u)), reported and corrected less the board's depth; NaN in cells without any."""


def choose(left: Residuals, camera: str) -> list[Chosen]:
    """The worst and the best view of a camera that were used, and the worst of those left out; in the recording's own frames."""
    views = [v for v in by_view(left.of(camera)) if " alone: " not in v.frame and np.isfinite(v.rms_px)]
    used = sorted((v for v in views if v.used_pixel), key=lambda v: -v.rms_px)
    out = [Chosen(used[0], "worst")] if used else []
    out += [Chosen(used[-1], "best")] if len(used) > 1 else []
    others = [v for v in views if not v.used_pixel]
    return out + ([Chosen(max(others, key=lambda v: v.rms_px), "left out")] if others else [])


def part_of(pixels_px: FloatArray, lens: Intrinsics) -> tuple[int, int, int, int]:
    """Left, top, right, bottom of the part of an image around corners (n, 2), as a slice has it."""
    low, high = pixels_px.min(axis=0), pixels_px.max(axis=0)
    margin = MARGIN * float(np.max(high - low)) + 8
    left, top = np.clip(np.floor(low - margin), 0, lens.size_px - 1).astype(int)
    right, bottom = np.clip(np.ceil(high + margin), 1, lens.size_px).astype(int)
    return int(left), int(top), int(right), int(bottom)


def depth_cells(
    points_m: FloatArray, T_color_board: FloatArray, board: Board, lens: Intrinsics, part: tuple[int, int, int, int]
) -> DepthCells | None:
    """What corrected depth on a board errs by, along the optical axis.

    Parameters
    ----------
    points_m : (h, w, 3), of a depth image, in the colour camera's frame.
    T_color_board : (4, 4), of the board's front.
    part : left, top, right, bottom of the picture, px.

    Returns
    -------
    None where no depth is on the board.
    """
    p = points_m.reshape(-1, 3)
    p = p[np.isfinite(p).all(axis=1) & (p[:, 2] > 0)]
    on_board = se3.transform(se3.inverse(T_color_board), p)
    rim = board.square_m
    inside = np.all((on_board[:, :2] > -rim) & (on_board[:, :2] < board.grid[-1] * board.square_m + rim), axis=1)
    p, on_board = p[inside], on_board[inside]
    across = (p / p[:, 2:]) @ T_color_board[:3, 2]  # of each ray, the part along the board's normal
    back = bool(len(across)) and float(np.median(across)) < 0
    with np.errstate(all="ignore"):
        error_m = (on_board[:, 2] - _surface(board, back, on_board[:, :2])) / across
    pixels = lens.project(p)
    left, top, right, bottom = part
    size = max(1.0, (right - left) / CELLS)
    columns, rows = int(np.ceil((right - left) / size)), int(np.ceil((bottom - top) / size))
    at = np.floor((pixels - [left - 0.5, top - 0.5]) / size)
    ok = np.isfinite(error_m) & (np.abs(error_m) < FAR_OFF_M) & np.all((at >= 0) & (at < [columns, rows]), axis=1)
    if not ok.any():
        return None
    cell = (at[ok, 1] * columns + at[ok, 0]).astype(int)
    n = np.bincount(cell, minlength=rows * columns)
    total = np.bincount(cell, 1e3 * error_m[ok], minlength=rows * columns)
    mean = np.where(n > 0, total / np.maximum(n, 1), np.nan).reshape(rows, columns)
    u = np.asarray(left - 0.5 + (np.arange(columns) + 0.5) * size)
    v = np.asarray(top - 0.5 + (np.arange(rows) + 0.5) * size)
    return DepthCells(u, v, mean)


def top_mm(pictures: Sequence[ViewPicture]) -> float:
    """What the colours of all pictures end at."""
    values = [np.abs(p.depth.error_mm[np.isfinite(p.depth.error_mm)]) for p in pictures if p.depth is not None]
    return float(f"{max(np.percentile(np.concatenate(values), 98), 1e-3):.2g}") if values else 1.0


def figures(picture: ViewPicture, top: float) -> tuple[Figure, float, Figure | None]:
    """The view with its corners and residuals, and by how much these are lengthened; and with its depth."""
    left = picture.left
    shown = np.isfinite(left.residual_px).all(axis=1)
    at, d = left.pixels_px[shown], left.residual_px[shown]
    scale = longest(d, _ARROW_SHARE * _spacing(at)) if len(at) else 1.0
    corners = {
        "type": "scatter",
        "mode": "markers",
        "x": plain(np.round(at[:, 0], 1)),
        "y": plain(np.round(at[:, 1], 1)),
        "marker": {"color": "#ffd400", "size": 5, "line": {"color": "#222", "width": 1}},
        "text": [f"corner {k}: {u:+.2f}, {v:+.2f} px" for k, (u, v) in zip(left.feature[shown], d, strict=True)],
        "hovertemplate": "%{text}<extra></extra>",
    }
    layers = [_photo(picture), corners, arrows(at, scale * d, color="#e0007a", width=2)]
    first = {"data": layers, "layout": _layout(picture)}
    depth = picture.depth
    if depth is None:
        return first, scale, None
    colors = heat(depth.u_px, depth.v_px, depth.error_mm, "%{z:+.1f} mm", SIGNS, -top, top)
    colors |= scale_bar("mm") | {"opacity": 0.75}
    return first, scale, {"data": [_photo(picture), colors], "layout": _layout(picture)}


def caption(picture: ViewPicture, scale: float) -> str:
    """What the first figure shows."""
    view = picture.chosen.view
    return f"{view.rms_px:.3f} px RMS; arrows {scale:g} times as long as the residuals"


def depth_caption(picture: ViewPicture) -> str:
    """What the second figure shows."""
    assert picture.depth is not None
    errors = picture.depth.error_mm[np.isfinite(picture.depth.error_mm)]
    return f"{errors.mean():+.2f} mm mean, {rms(errors):.2f} mm RMS of the cells; red reads too far, blue too near"


def rows_of(left: Residuals, chosen: Chosen) -> Residuals:
    """The residuals of one view."""
    return left.select((left.camera == chosen.view.camera) & (left.frame == chosen.view.frame))


def board_pose(sensor: Sensor, boards: Mapping[str, FloatArray], frame: str) -> FloatArray | None:
    """T_color_board (4, 4) of a frame; None where the board was not posed in it."""
    return se3.inverse(sensor.T_world_sensor) @ boards[frame] if frame in boards else None


def _surface(board: Board, back: bool, places_m: FloatArray) -> FloatArray:
    """Height (n,), metres, of a face over the board's plane: the smooth part of its shape, of second degree."""
    shape = board.shape
    points = (shape.back_m if back else shape.front_m) if shape is not None else None
    if points is None:
        return np.full(len(places_m), board.thickness_m if back else 0.0)

    def terms(p: FloatArray) -> FloatArray:
        x, y = p[:, 0], p[:, 1]
        return np.stack([np.ones(len(p)), x, y, x * x, x * y, y * y], axis=1)

    return np.asarray(terms(places_m) @ np.linalg.lstsq(terms(points[:, :2]), points[:, 2], rcond=None)[0])


def _spacing(at: FloatArray) -> float:
    """Median distance of a corner from its nearest neighbour, px."""
    if len(at) < MIN_CORNERS:
        return 20.0
    apart = np.linalg.norm(at[:, None] - at[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    return float(np.median(apart.min(axis=1)))


def _photo(picture: ViewPicture) -> Figure:
    u, v = picture.corner_px
    source, step = jpeg(picture.image, WIDEST_PX)
    middle = (step - 1) / 2  # of the pixels that became one
    return {
        "type": "image",
        "source": source,
        "x0": u + middle,
        "y0": v + middle,
        "dx": step,
        "dy": step,
        "hoverinfo": "skip",
    }


def _layout(picture: ViewPicture) -> Figure:
    (u, v), (h, w) = picture.corner_px, picture.image.shape[:2]
    return image_layout(u - 0.5, u + w - 0.5, v - 0.5, v + h - 0.5, 300)

"""One camera by itself: its lens, its depth over range and image, and where its depth image is beside the colour image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.depth_error import PolynomialField
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.residuals import Residuals
from rgbd_calib.quality import BiasSamples
from rgbd_calib.report.plots import (
    SIGNS,
    SIZES,
    Figure,
    arrows,
    axes,
    css_color,
    dots,
    heat,
    image_layout,
    longest,
    plain,
    scale_bar,
)
from rgbd_calib.types import DepthBias, RigCamera

FINE, COARSE = (32, 24), (8, 6)
"""Columns and rows of colours, and of arrows, over an image."""
LONGEST = 2.0
"""Of an arrow that is drawn, in cells: longer ones are where a lens model folds."""
DEPTHS = 3
_ARROW_SHARE = 0.9  # of a coarse cell
_REGISTERED_SHARE = 0.1
"""Of the image's width: depth shifted by more is not registered to colour, and a picture of it says nothing."""
_NAMES = {
    "opencv": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"),
    "kannala_brandt": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}


@dataclass(frozen=True)
class Parameter:
    """One number of a lens."""

    name: str
    value: float
    sd: float | None
    start: float | None
    """What the calibration started from; None where that is not known."""


@dataclass(frozen=True)
class Beside:
    """Where the depth image is beside the colour image."""

    rms_px: float
    """Shift over the image; NaN where the two are not registered."""
    at_m: float
    baseline_mm: float
    baseline_sd_mm: float | None
    turn_deg: float
    turn_sd_deg: float | None
    lens: Intrinsics


def parameters(lens: Intrinsics, sd: Any, start: Intrinsics | None) -> list[Parameter]:
    """Focal lengths and centre in px, and the distortion."""
    names = _NAMES.get(lens.model, ())
    before = start.vector if start is not None and start.model == lens.model else np.empty(0)
    sd = np.empty(0) if sd is None else np.asarray(sd, float)
    return [
        Parameter(
            names[i] if i < len(names) else f"d{i - 3}",
            float(value),
            float(sd[i]) if i < len(sd) else None,
            float(before[i]) if i < len(before) else None,
        )
        for i, value in enumerate(lens.vector)
        if i < 9 or value != 0 or (i < len(before) and before[i] != 0)
    ]


def pixels_over(lens: Intrinsics, cells: tuple[int, int]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Middles u (columns,), v (rows,) of cells of an image, and all of them (rows, columns, 2)."""
    u = (np.arange(cells[0]) + 0.5) * lens.width / cells[0] - 0.5
    v = (np.arange(cells[1]) + 0.5) * lens.height / cells[1] - 0.5
    return u, v, np.stack(np.meshgrid(u, v), axis=-1)


def distortion_at(lens: Intrinsics, pixels: FloatArray) -> FloatArray:
    """Pixels less where a lens without distortion would have them (..., 2); NaN beyond the lens model."""
    rays = lens.rays(pixels.reshape(-1, 2)).reshape(*pixels.shape[:-1], 3)
    return np.asarray(pixels - (rays[..., :2] * [lens.fx, lens.fy] + [lens.cx, lens.cy]))


def change_at(lens: Intrinsics, start: Intrinsics, pixels: FloatArray) -> FloatArray:
    """Pixels less where another lens has the same rays (..., 2)."""
    flat = pixels.reshape(-1, 2)
    return np.asarray((flat - start.project(lens.rays(flat))).reshape(pixels.shape))


def shift_over_image(lens: Intrinsics, shift: Any, what: str) -> tuple[Figure, float, float]:
    """A shift in px by pixel as colours and arrows; by how much the arrows are lengthened; the largest shift."""
    u, v, pixels = pixels_over(lens, FINE)
    size = np.linalg.norm(shift(pixels), axis=-1)
    top = float(np.nanmax(size, initial=0.0))
    coarse = pixels_over(lens, COARSE)[2]
    d = shift(coarse)
    room = _ARROW_SHARE * lens.width / COARSE[0]
    scale = longest(d, room)
    d[np.linalg.norm(scale * d, axis=-1) > LONGEST * room] = np.nan  # colours show them; arrows would cross the picture
    # arrows end at the pixel where the shift leads, so that they stay inside the image
    trace = heat(u, v, size, f"%{{z:.2f}} px {what}", SIZES, 0, top or 1.0) | scale_bar("px")
    layout = image_layout(-0.5, lens.width - 0.5, -0.5, lens.height - 0.5, 230)
    return {"data": [trace, arrows(coarse - scale * d / 2, scale * d)], "layout": layout}, scale, top


def depth_over_image(own: RigCamera) -> list[tuple[float, float | None, float, Figure]]:
    """(depth in m, mean standard deviation in mm, RMS in mm, figure) of what the depth errs by over the image, at some depths, reported less true; empty without a field."""
    field = own.depth_field
    if field is None:
        return []
    lens = own.depth_sensor.camera.intrinsics
    low, high = own.depth_bias.measured_m if own.depth_bias is not None else _ends(field)
    u, v, pixels = pixels_over(lens, FINE)
    at_m = np.linspace(low, high, DEPTHS)
    maps = [-1e3 * field.error_m(pixels, np.full(pixels.shape[:-1], z)) for z in at_m]
    top = max(float(np.nanmax(np.abs(m))) for m in maps) or 1.0
    out = []
    for z, errors in zip(at_m, maps, strict=True):
        trace = heat(u, v, errors, "%{z:+.2f} mm", SIGNS, -top, top) | scale_bar("mm")
        layout = image_layout(-0.5, lens.width - 0.5, -0.5, lens.height - 0.5, 200)
        rms_mm = float(np.sqrt(np.nanmean(errors**2)))
        out.append((float(z), _field_sd_mm(field, pixels, float(z)), rms_mm, {"data": [trace], "layout": layout}))
    return out


def beside(own: RigCamera, at_m: float) -> tuple[Beside, Figure | None, float] | None:
    """Registration of depth to colour at a distance, as numbers and as arrows, and by how much these are lengthened.

    No figure where the depth image is not registered at all. None where depth has the colour camera's geometry.
    """
    depth = own.depth_camera
    if depth is None:
        return None
    lens, T = own.intrinsics, depth.T_color_depth

    def shift(pixels: FloatArray) -> FloatArray:
        flat = pixels.reshape(-1, 2)
        p = se3.transform(se3.inverse(T), lens.unproject(flat, np.full(len(flat), at_m)))
        return np.asarray((depth.intrinsics.project(p) - flat).reshape(pixels.shape))

    baseline = float(np.linalg.norm(T[:3, 3]))
    turn = so3.log(T[:3, :3])
    baseline_sd = turn_sd = None
    if depth.covariance is not None:
        C = np.asarray(depth.covariance)[4:, 4:]
        J = np.concatenate([-so3.hat(T[:3, 3]), np.eye(3)], axis=1)  # of the origin, by the left perturbation
        baseline_sd = 1e3 * along(T[:3, 3], J @ C @ J.T)
        turn_sd = float(np.degrees(along(turn, C[:3, :3])))
    rms = float(np.sqrt(np.nanmean(np.sum(shift(pixels_over(lens, FINE)[2]) ** 2, axis=-1))))
    registered = (lens.width, lens.height) == (depth.intrinsics.width, depth.intrinsics.height)
    # a depth camera that was calibrated as a camera of its own has statistics of its own
    registered &= own.statistics.depth_statistics is None and rms < _REGISTERED_SHARE * lens.width
    numbers = Beside(
        rms if registered else float("nan"),
        at_m,
        1e3 * baseline,
        baseline_sd,
        float(np.degrees(np.linalg.norm(turn))),
        turn_sd,
        depth.intrinsics,
    )
    if not registered:
        return numbers, None, 1.0
    drawn, scale, _ = shift_over_image(lens, shift, "shift")
    return numbers, drawn, scale


def along(d: FloatArray, C: FloatArray) -> float:
    """Standard deviation of a vector d (n,) along itself, of covariance C (n, n); the largest of all ways where d is zero."""
    length = float(np.linalg.norm(d))
    widest = float(np.linalg.eigvalsh((C + C.T) / 2)[-1]) if length < 1e-12 else float(d @ C @ d) / length**2
    return float(np.sqrt(max(widest, 0.0)))


def depth_bias(bias: DepthBias, samples: BiasSamples | None, left: Residuals | None, index: int) -> Figure:
    """Correction by reported depth: the curve, its standard error, and the data behind it."""
    z = np.linspace(bias.min_m, bias.max_m, 60)
    mm = 1e3 * (bias.correct(z) - z)
    traces = []
    if bias.covariance is not None:
        se = 1e3 * bias.standard_error(z)
        traces.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": "± 1 standard error",
                "x": plain(np.round(np.concatenate([z, z[::-1]]), 4)),
                "y": plain(np.round(np.concatenate([mm + se, (mm - se)[::-1]]), 3)),
                "fill": "toself",
                "fillcolor": "rgba(79, 134, 184, 0.3)",
                "line": {"width": 0},
                "hoverinfo": "skip",
            }
        )
    if left is not None:
        boards = _board_depths(left, bias)
        traces.append(dots("boards, one dot a view", *boards, "#9a9a9a", 5, "circle"))
    if samples is not None:
        z_m, true_m = samples.z_m, samples.z_true_m
        out = np.array(samples.dropped or np.zeros(len(z_m)), bool)
        traces.append(dots("bias recording", z_m[~out], (true_m - z_m)[~out], css_color(index), 8, "diamond"))
        if out.any():
            traces.append(dots("left out", z_m[out], (true_m - z_m)[out], css_color(index), 9, "x"))
    traces.append(
        {
            "type": "scatter",
            "mode": "lines",
            "name": "correction",
            "x": plain(np.round(z, 4)),
            "y": plain(np.round(mm, 3)),
            "line": {"color": "#1c4f7c", "width": 2.5},
        }
    )
    return {"data": traces, "layout": axes("depth as reported, m", "true - reported, mm") | {"height": 320}}


def _board_depths(left: Residuals, bias: DepthBias) -> tuple[FloatArray, FloatArray]:
    """Median reported depth and median of true - reported, both metres, of each view with depth."""
    rows = left.select(left.used_depth)
    if not len(rows.frame):
        return np.empty(0), np.empty(0)
    missing = bias.correct(rows.depth_m) - rows.residual_depth_m - rows.depth_m
    groups = [rows.frame == frame for frame in np.unique(rows.frame)]
    return np.array([np.median(rows.depth_m[g]) for g in groups]), np.array([np.median(missing[g]) for g in groups])


def _ends(field: Any) -> tuple[float, float]:
    return (field.min_m, field.max_m) if isinstance(field, PolynomialField) else (field.z_m[0], field.z_m[-1])


def _field_sd_mm(field: Any, pixels: FloatArray, z_m: float) -> float | None:
    """RMS over the image of the field's standard deviation; None where its covariance is not known."""
    if not isinstance(field, PolynomialField) or field.covariance is None:
        return None
    z = np.full(pixels.shape[:-1], z_m)
    J = field.by_parameters(pixels, z)
    variance = np.einsum("...p,pq,...q->...", J, field.covariance, J) + field.pattern_variance_m2(z)
    return 1e3 * float(np.sqrt(np.mean(np.maximum(variance, 0))))

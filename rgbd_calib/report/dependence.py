"""Residuals against what they may depend on: image radius, range, tilt of the board, time.

The corners of one view share the error of its board's pose, so that the scatter between views, and not between corners,
says how sure a mean is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.residuals import Residuals
from rgbd_calib.report.numbers import Sensor
from rgbd_calib.report.plots import Figure, axes, line, plain
from rgbd_calib.views.coverage import ViewCoverage

BINS = 8
"""At most; fewer where bins would hold too few views."""
MIN_VIEWS = 3
"""In a bin: fewer say nothing of their scatter."""
AGAINST = {
    "radius": "distance from the principal point, px",
    "range": "distance of the board, m",
    "tilt": "tilt of the board, °",
    "time": "number of the frame",
}


@dataclass(frozen=True)
class Trend:
    """Mean of something over views, in bins of something else."""

    at: FloatArray
    """(n,), means of x in the bins."""
    mean: FloatArray
    error: FloatArray
    """(n,), standard errors of the means."""


def trend(x: FloatArray, values: FloatArray, view: np.ndarray) -> Trend:
    """Values (n,) in bins of x (n,) of equal counts, as many as hold enough views, two at least; none where there are too few.

    `view` (n,) says which belong together. NaN are left out.
    """
    ok = np.isfinite(x) & np.isfinite(values)
    x, values, view = x[ok], values[ok], view[ok]
    for bins in range(BINS, 1, -1) if len(x) else ():
        edges = np.quantile(x, np.arange(1, bins) / bins)
        number = np.searchsorted(edges, x, side="right")
        rows = [_mean(x[own], values[own], view[own]) for own in (number == b for b in range(bins))]
        if None not in rows:
            return Trend(*np.array(rows, float).T)
    return Trend(*np.empty((3, 0)))


def _mean(x: FloatArray, values: FloatArray, view: np.ndarray) -> tuple[float, float, float] | None:
    """Mean of x, mean over views of the views' means, and its standard error; None of too few views."""
    _, group = np.unique(view, return_inverse=True)
    n = np.bincount(group)
    if len(n) < MIN_VIEWS:
        return None
    means = np.bincount(group, values) / n
    return float(x.mean()), float(means.mean()), float(means.std(ddof=1) / np.sqrt(len(n)))


def against(r: Residuals, sensor: Sensor, placed: Mapping[tuple[str, str], ViewCoverage]) -> dict[str, FloatArray]:
    """By key of `AGAINST`, what each row (n,) of one sensor's residuals was measured at; NaN where it is not known."""
    lens = sensor.intrinsics
    views = [placed.get((sensor.name, str(frame))) for frame in r.frame]
    own = [frame for frame in np.unique(r.frame) if " alone: " not in frame]
    number = {str(frame): float(i) for i, frame in enumerate(own)}
    return {
        "radius": np.linalg.norm(r.pixels_px - [lens.cx, lens.cy], axis=1),
        "range": np.array([np.nan if v is None else v.distance_m for v in views]),
        "tilt": np.degrees([np.nan if v is None else v.tilt_rad for v in views]),
        "time": np.array([number.get(str(frame), np.nan) for frame in r.frame]),
    }


def dependences(
    left: Residuals, sensors: Sequence[Sensor], placed: Sequence[ViewCoverage]
) -> dict[str, dict[str, dict[str, Trend]]]:
    """Trends by what (px, radial, depth), against what, and sensor; of what was used. Those without a bin are left out.

    px is the mean square of a coordinate's residual, px^2; radial the part away from the principal point, px; depth in metres.
    """
    by_view = {(v.camera, v.frame): v for v in placed}
    out: dict[str, dict[str, dict[str, Trend]]] = {"px": {}, "radial": {}, "depth": {}}
    for sensor in sensors:
        rows = left.of(sensor.name)
        if not len(rows.frame):
            continue
        outward = rows.pixels_px - [sensor.intrinsics.cx, sensor.intrinsics.cy]
        outward = outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
        values = {
            "px": np.where(rows.used_pixel, (rows.residual_px**2).mean(axis=1), np.nan),
            "radial": np.where(rows.used_pixel, (rows.residual_px * outward).sum(axis=1), np.nan),
            "depth": np.where(rows.used_depth, rows.residual_depth_m, np.nan),
        }
        for key, x in against(rows, sensor, by_view).items():
            for what, value in values.items():
                found = trend(x, value, rows.frame)
                if len(found.at) and (what != "radial" or key == "radius"):
                    out[what].setdefault(key, {})[sensor.name] = found
    return out


def figure(what: str, key: str, trends: Mapping[str, Trend], names: Sequence[str]) -> Figure:
    """One line for each sensor, with bars of one standard error."""
    traces = []
    for name, own in trends.items():
        mean, error = own.mean, own.error
        if what == "px":
            mean = np.sqrt(own.mean)
            error = own.error / np.maximum(2 * mean, 1e-9)
        elif what == "depth":
            mean, error = 1e3 * own.mean, 1e3 * own.error
        bars = {"type": "data", "array": plain(np.round(error, 5)), "thickness": 1, "width": 3}
        traces.append(line(name, own.at, mean, list(names).index(name)) | {"error_y": bars})
    label = {"px": "residual, px RMS", "radial": "outward residual, px", "depth": "depth residual, mm"}[what]
    layout = axes(AGAINST[key], label) | {"height": 280}
    if what == "px":
        layout["yaxis"]["rangemode"] = "tozero"
    return {"data": traces, "layout": layout}

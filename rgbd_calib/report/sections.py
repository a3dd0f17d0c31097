"""What the sections of the report say and draw; each adds its figures to those that are drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rgbd_calib.io.residuals import Residuals
from rgbd_calib.quality import BiasSamples
from rgbd_calib.report import (
    camera_pages,
    coverage_map,
    dependence,
    error_map,
    figures,
    numbers,
    print_map,
    view_pictures,
)
from rgbd_calib.report.html import by_camera
from rgbd_calib.report.numbers import DEPTH, Sensor
from rgbd_calib.report.plots import Figure
from rgbd_calib.trust.verdict import Verdict
from rgbd_calib.types import Board, Rig
from rgbd_calib.views.coverage import Coverage, CoverageParams, ViewCoverage
from rgbd_calib.views.range_coverage import range_coverage

Drawn = dict[str, Figure]
FIRST_STEPS = 4
"""Of what to do next that are shown at once."""


def verdict_words(verdict: Verdict, cameras: Sequence[str]) -> dict[str, Any]:
    """The verdict with one reason, and the rest: sentences that several cameras share as one.

    Where a self-check failed, no number is called good.
    """
    if verdict.level == "untrusted":  # the headline is the reason
        said = verdict.because[0].finding
        reasons = ["", *(own.ungraded for own in verdict.because if own.finding is None or own.finding != said)]
    else:
        good = verdict.level == "good"
        telling_first = sorted(
            verdict.because, key=lambda own: not (own.tested if good else own.grade == verdict.level)
        )
        reasons = [str(own) for own in telling_first]
    steps = by_camera(list(verdict.next_steps), list(cameras))
    return {"reason": reasons[0] if reasons else "", "reasons": reasons[1:], "steps": steps, "first_steps": FIRST_STEPS}


def images(drawn: Drawn, views: Sequence[view_pictures.ViewPicture]) -> list[dict[str, Any]]:
    """The chosen views, each with its two figures."""
    top, out = view_pictures.top_mm(views), []
    for i, one in enumerate(views):
        first, scale, second = view_pictures.figures(one, top)
        drawn[f"view_{i}"] = first
        row = {"id": i, "camera": one.chosen.view.camera, "frame": one.chosen.view.frame, "why": one.chosen.why}
        row |= {"caption": view_pictures.caption(one, scale), "depth": ""}
        if second is not None:
            drawn[f"view_{i}_depth"] = second
            row["depth"] = view_pictures.depth_caption(one)
        out.append(row)
    return out


def volume(drawn: Drawn, rig: Rig) -> dict[str, Any] | None:
    """The expected error in slices; None where the rig file has none."""
    grid = error_map.grid_of(rig.quality)
    if grid is None:
        return None
    above, across = error_map.from_above(grid, rig), error_map.across(grid)
    drawn |= {f"above_{i}": own for i, (_, own) in enumerate(above)}
    drawn |= {f"across_{i}": own for i, (_, own) in enumerate(across)}
    return {
        "above": [at for at, _ in above],
        "across": [at for at, _ in across],
        "rows": error_map.by_distance(grid),
        "shares": error_map.shares(grid),
    }


@dataclass(frozen=True)
class Covered:
    """Coverage in numbers, and where nothing was filmed, by camera."""

    coverage: Coverage
    empty: dict[str, list[str]]


def coverage(drawn: Drawn, rig: Rig, placed: Sequence[ViewCoverage]) -> Covered:
    """Coverage of images and ranges."""
    own = numbers.coverage_of_rig(rig, placed)
    ranges = range_coverage([v for v in placed if v.camera in rig.cameras], list(rig.cameras))
    for i, name in enumerate(rig.cameras):
        drawn[f"coverage_{i}"] = coverage_map.figure(ranges[name])
    drawn["depth_ranges"] = figures.depth_ranges(own.cameras, CoverageParams())
    return Covered(own, {name: ranges[name].empty for name in rig.cameras})


def cameras(drawn: Drawn, rig: Rig, left: Residuals | None, start: Rig | None, at_m: float) -> list[dict[str, Any]]:
    """A page for each camera: lens, depth, registration."""
    samples = rig.quality.depth_bias_samples or {}
    out = []
    for i, (name, own) in enumerate(rig.cameras.items()):
        lens = own.intrinsics
        first = start.cameras[name].intrinsics if start is not None and name in start.cameras else None
        page: dict[str, Any] = {"name": name, "id": i, "depth": [], "beside": None, "changed": None, "lens": lens}
        page["parameters"] = camera_pages.parameters(lens, own.statistics.intrinsics_sd, first)
        drawn[f"lens_{i}"], scale, top = camera_pages.shift_over_image(
            lens, lambda p, lens=lens: camera_pages.distortion_at(lens, p), "distortion"
        )
        page["distortion"] = {"scale": scale, "top": top}
        if first is not None and (first.width, first.height) == (lens.width, lens.height) and first != lens:
            drawn[f"changed_{i}"], scale, top = camera_pages.shift_over_image(
                lens, lambda p, a=lens, b=first: camera_pages.change_at(a, b, p), "change"
            )
            page["changed"] = {"scale": scale, "top": top}
        if own.depth_bias is not None:
            table = (
                left.of(name + DEPTH if own.depth_camera is not None and _has(left, name + DEPTH) else name)
                if left
                else None
            )
            drawn[f"bias_{i}"] = camera_pages.depth_bias(own.depth_bias, _samples(samples, name), table, i)
        for k, (z_m, sd_mm, rms_mm, figure) in enumerate(camera_pages.depth_over_image(own)):
            drawn[f"field_{i}_{k}"] = figure
            page["depth"].append({"z_m": z_m, "sd_mm": sd_mm, "rms_mm": rms_mm})
        if (found := camera_pages.beside(own, at_m)) is not None:
            page["beside"], arrows, page["beside_scale"] = found
            if arrows is not None:
                drawn[f"beside_{i}"] = arrows
        out.append(page)
    return out


def board_print(drawn: Drawn, board: Board | None) -> list[dict[str, Any]]:
    """The faces of the board as printed; empty where its shape is not known."""
    out: list[dict[str, Any]] = []
    for sheet in print_map.sheets_of(board) if board is not None else []:
        assert board is not None
        scale = 1.0
        if sheet.determined:
            drawn[f"print_{sheet.face}"], scale = print_map.figure(sheet, 1e3 * board.square_m)
            drawn[f"bow_{sheet.face}"] = print_map.bow(sheet, board)
        out.append(
            {
                "sheet": sheet,
                "scale": scale,
                "local_mm": numbers.rms(sheet.local_mm),
                "bow_mm": float(np.ptp(sheet.height_mm)),
            }
        )
    return out


def residuals(
    drawn: Drawn, sensors: Sequence[Sensor], left: Residuals, placed: Sequence[ViewCoverage]
) -> dict[str, Any]:
    """Residuals by view, over the image, and against what they may depend on."""
    names = [sensor.name for sensor in sensors]
    rows = numbers.by_view(left)
    drawn["views_px"] = figures.views(rows, names, depth=False)
    sizes = [(own.intrinsics.width, own.intrinsics.height) for own in sensors]
    cells = [numbers.over_image(left.of(own.name), *size) for own, size in zip(sensors, sizes, strict=True)]
    top_px = max((float(np.nanmax(c.rms_px, initial=0.0)) for c in cells), default=0.0)
    top_mm = max((float(1e3 * np.nanmax(np.abs(c.mean_depth_m), initial=0.0)) for c in cells), default=0.0)
    scales = {}
    for i, (sensor, size, own) in enumerate(zip(sensors, sizes, cells, strict=True)):
        if np.isfinite(own.rms_px).any():
            drawn[f"image_px_{i}"], scales[sensor.name] = figures.image_px(own, *size, top_px or 1.0)
        if np.isfinite(own.mean_depth_m).any():
            drawn[f"image_depth_{i}"] = figures.image_depth(own, *size, top_mm or 1.0)
    if any(np.isfinite(own.mean_depth_m).any() for own in cells):
        drawn["views_depth"] = figures.views(rows, names, depth=True)
    for what, by_key in dependence.dependences(left, sensors, placed).items():
        for key, trends in by_key.items():
            drawn[f"{what}_{key}"] = dependence.figure(what, key, trends, names)
    return {
        "names": names,
        "arrows": scales,
        "top_px": top_px,
        "top_mm": top_mm,
        "table": numbers.camera_table(left, names),
    }


def rounds(drawn: Drawn, rig: Rig, at_m: float) -> None:
    """How the weights settled."""
    history = rig.quality.rounds or ()
    if not history:
        return
    names = sorted({name for r in history for name in r.depth_k_per_m or ()}, key=_in_order(rig)) or list(rig.cameras)
    if history[0].sigma_2d_px is not None:
        drawn["rounds_px"] = figures.rounds([r.sigma_2d_px for r in history], "pixel noise, px", 1.0, names)
    if history[0].depth_k_per_m is not None:
        depth = [{n: k * at_m**2 for n, k in (r.depth_k_per_m or {}).items()} for r in history]
    elif history[0].sigma_3d_m is not None:
        depth = [dict.fromkeys(names, r.sigma_3d_m) for r in history if r.sigma_3d_m is not None]
    else:
        return
    pixel = [
        own if isinstance(own := r.sigma_2d_px, Mapping) else dict.fromkeys(names, own)
        for r in history
        if r.sigma_2d_px is not None
    ]
    if len(pixel) != len(depth):
        return
    weight = [{n: 1e3 * d[n] / p[n] for n in d if n in p} for d, p in zip(depth, pixel, strict=True)]
    drawn["rounds_depth"] = figures.rounds(depth, "depth noise, mm", 1e3, names)
    drawn["rounds_weight"] = figures.rounds(weight, "mm of depth worth 1 px", 1.0, names)


def _has(left: Residuals | None, name: str) -> bool:
    return left is not None and bool(np.any(left.camera == name))


def _samples(samples: Mapping[str, BiasSamples], name: str) -> BiasSamples | None:
    return samples.get(name + DEPTH, samples.get(name))


def _in_order(rig: Rig) -> Any:
    order = {name: i for i, name in enumerate(rig.cameras)}
    return lambda name: (order.get(name.removesuffix(DEPTH), len(order)), name)

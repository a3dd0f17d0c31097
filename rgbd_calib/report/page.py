"""The report as one HTML file: what it says, its figures, and the template that they go into."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.plain import to_json, to_json_in_html
from rgbd_calib.io.residuals import Residuals
from rgbd_calib.io.rig import board_in
from rgbd_calib.report import figures, numbers
from rgbd_calib.report.figures import Figure, css_color
from rgbd_calib.report.scene import scene
from rgbd_calib.trust.verdict import USUAL_M, limits_in
from rgbd_calib.types import Board, Rig
from rgbd_calib.views.coverage import Coverage, CoverageParams


@dataclass(frozen=True)
class Picture:
    """The fused cloud from one side, before and after."""

    view: str
    before: np.ndarray
    """(h, w, 3), uint8, R G B."""
    after: np.ndarray


@dataclass(frozen=True)
class Contents:
    """All that a report is made of; what is missing is said in `missing`, by section."""

    title: str
    rig: Rig
    boards: Mapping[str, FloatArray]
    """T_world_board (4, 4) by frame."""
    residuals: Residuals | None
    pictures: tuple[Picture, ...] = ()
    cloud_note: str = ""
    missing: Mapping[str, str] = field(default_factory=dict)
    """Sentences by section: residuals, clouds, depth_bias."""


def render(contents: Contents) -> str:
    """The whole page, with its script, styles and pictures inside."""
    import jinja2
    from plotly.offline import get_plotlyjs

    rig, quality = contents.rig, contents.rig.quality
    board = board_in(quality)
    left = contents.residuals
    coverage = numbers.coverage_of_rig(rig, left)
    drawn: dict[str, Figure] = {"scene": _scene(contents, board)}
    if coverage is not None:
        drawn |= _coverage_figures(coverage)
    scales = _residual_figures(drawn, rig, left) if left is not None else None
    _bias_figures(drawn, rig, left)
    if quality.get("pairs"):
        drawn["pairs"] = figures.pair_graph(list(rig.cameras), quality["pairs"])
    at_m = _usual_distance_m(left)
    _round_figures(drawn, rig, at_m)
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rgbd_calib.report", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["commands"] = _commands
    return environment.get_template("report.html").render(
        title=contents.title,
        rig=rig,
        quality=quality,
        provenance=rig.provenance,
        verdict=numbers.verdict_of(rig, left),
        limits=_limits(rig),
        colors={name: css_color(i) for i, name in enumerate(rig.cameras)},
        poses=_poses(rig),
        pairs=_pair_rows(quality),
        table=numbers.camera_table(left, {name: own.statistics for name, own in rig.cameras.items()}) if left else [],
        coverage=coverage,
        scales=scales,
        drawn=drawn,
        dropped=_dropped(quality),
        at_m=at_m,
        pictures=[(p.view, _jpeg(p.before), _jpeg(p.after)) for p in contents.pictures],
        cloud_note=contents.cloud_note,
        missing=contents.missing,
        figures_json=to_json_in_html({f"fig_{k}": v for k, v in drawn.items()}),
        plotly=get_plotlyjs(),
        config=to_json(rig.provenance.get("config", {}), indent=1),
    )


def _limits(rig: Rig) -> dict[str, float]:
    own, at_m = limits_in(rig.provenance), float(rig.quality.get("working_distance_m", USUAL_M))
    return {"good": own.good_mm(at_m), "fair": own.fair_mm(at_m), "noise": own.noise_factor, "at_m": at_m}


def _scene(contents: Contents, board: Board | None) -> Figure:
    rig = contents.rig
    grid = rig.quality.get("expected_alignment", {}).get("grid")
    points = np.array(grid["points_in_reference_m"], float) if grid else np.empty((0, 3))
    error = np.array(grid["error_mm"], float) if grid else np.empty(0)
    in_world = se3.transform(rig.cameras[rig.reference].T_world_color, points) if grid else points
    return scene(rig, contents.boards, board, in_world, error)


def _coverage_figures(coverage: Coverage) -> dict[str, Figure]:
    drawn = {f"coverage_{i}": figures.coverage_map(own) for i, own in enumerate(coverage.cameras.values())}
    drawn["depth_ranges"] = figures.depth_ranges(coverage.cameras, CoverageParams())
    return drawn


@dataclass(frozen=True)
class Scales:
    """What the colours and arrows over the images stand for."""

    arrows: dict[str, float]
    """By camera, by how much the arrows are lengthened."""
    top_px: float
    top_mm: float


def _residual_figures(drawn: dict[str, Figure], rig: Rig, left: Residuals) -> Scales:
    """Adds the figures of residuals."""
    names = list(rig.cameras)
    rows = numbers.by_view(left)
    drawn["views_px"] = figures.views(rows, names, depth=False)
    cells = {
        name: numbers.over_image(left.of(name), own.intrinsics.width, own.intrinsics.height)
        for name, own in rig.cameras.items()
    }
    bins = {name: numbers.over_distance(left.of(name)) for name in names}
    top_px = max((float(np.nanmax(c.rms_px, initial=0.0)) for c in cells.values()), default=0.0)
    top_mm = max((float(1e3 * np.nanmax(np.abs(c.mean_depth_m), initial=0.0)) for c in cells.values()), default=0.0)
    scales = {}
    for i, (name, own) in enumerate(rig.cameras.items()):
        size = own.intrinsics.width, own.intrinsics.height
        drawn[f"image_px_{i}"], scales[name] = figures.image_px(cells[name], *size, top_px or 1.0)
        if np.isfinite(cells[name].mean_depth_m).any():
            drawn[f"image_depth_{i}"] = figures.image_depth(cells[name], *size, top_mm or 1.0)
    if any(len(b.depth_m) for b in bins.values()):
        drawn["views_depth"] = figures.views(rows, names, depth=True)
        drawn["distance_depth"] = figures.distance_depth(bins)
        drawn["distance_px"] = figures.distance_px(bins)
    return Scales(scales, top_px, top_mm)


def _bias_figures(drawn: dict[str, Figure], rig: Rig, left: Residuals | None) -> None:
    samples = rig.quality.get("depth_bias_samples", {})
    for i, (name, own) in enumerate(rig.cameras.items()):
        if own.depth_bias is not None:
            mine = left.of(name) if left is not None else None
            drawn[f"bias_{i}"] = figures.depth_bias(own.depth_bias, samples.get(name), mine, i)


def _round_figures(drawn: dict[str, Figure], rig: Rig, at_m: float) -> None:
    history = rig.quality.get("rounds", [])
    if not history:
        return
    names = list(rig.cameras)
    if "sigma_2d_px" in history[0]:
        drawn["rounds_px"] = figures.rounds(history, "sigma_2d_px", "pixel noise, px", 1.0, names)
    if "depth_k_per_m" in history[0]:
        depth = [{n: r["depth_k_per_m"][n] * at_m**2 for n in names if n in r["depth_k_per_m"]} for r in history]
    elif "sigma_3d_m" in history[0]:
        depth = [{n: r["sigma_3d_m"] for n in names} for r in history]
    else:
        return
    pixel = [
        r["sigma_2d_px"] if isinstance(r["sigma_2d_px"], dict) else dict.fromkeys(names, r["sigma_2d_px"])
        for r in history
        if "sigma_2d_px" in r
    ]
    if len(pixel) != len(depth):
        return
    weight = [{n: 1e3 * d[n] / p[n] for n in d if n in p} for d, p in zip(depth, pixel, strict=True)]
    drawn["rounds_depth"] = figures.rounds([{"x": d} for d in depth], "x", "depth noise, mm", 1e3, names)
    drawn["rounds_weight"] = figures.rounds([{"x": w} for w in weight], "x", "mm of depth worth 1 px", 1.0, names)


def _usual_distance_m(left: Residuals | None) -> float:
    """Median depth of what was used, to half a metre: where a noise that grows with distance is shown."""
    used = left.depth_m[left.used_depth] if left is not None else np.empty(0)
    return max(0.5, round(2 * float(np.median(used))) / 2) if len(used) else 2.0


def _poses(rig: Rig) -> list[dict[str, Any]]:
    rows = []
    for name, own in rig.cameras.items():
        sd = np.sqrt(np.maximum(np.diag(own.covariance), 0))
        rows.append(
            {
                "camera": name,
                "place": own.T_world_color[:3, 3],
                "sd_mm": 1e3 * float(sd[3:].max()),
                "sd_deg": float(np.degrees(sd[:3].max())),
                "sure": "reference" if name == rig.reference else "" if sd.any() else "not estimated by this method",
                "lens": own.intrinsics,
                "lens_sd": own.statistics.get("intrinsics_sd"),
            }
        )
    return rows


def _pair_rows(quality: Mapping[str, Any]) -> list[dict[str, Any]]:
    expected = quality.get("expected_alignment", {}).get("pairs", {})
    measured = quality.get("alignment_on_recording", {}).get("pairs", {})
    rows = []
    for pair in quality.get("pairs", []):
        a, b = pair["cameras"]
        keys = (f"{a} - {b}", f"{b} - {a}")
        rows.append(
            pair
            | {
                "expected": next((expected[k] for k in keys if k in expected), None),
                "measured": next((measured[k] for k in keys if k in measured), {}),
            }
        )
    return rows


def _dropped(quality: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """(camera, frame, why) of views that were left out, wholly or in part."""
    rows = []
    for key in ("views_not_associated", "dropped"):
        for name, frames in quality.get(key, {}).items():
            rows += [(name, frame, why) for frame, why in frames.items()]
    for view in quality.get("plane_filter", {}).get("dropped_depth", []):
        name, _, frame = view.partition(" ")
        rows.append((name, frame, "depth rejected: it does not lie on the board's plane"))
    return rows


def _commands(text: str) -> Any:
    """Text with what stands between backticks as code, the rest escaped."""
    import markupsafe

    parts = [markupsafe.escape(part) for part in text.split("`")]
    return markupsafe.Markup("".join(f"<code>{p}</code>" if i % 2 else p for i, p in enumerate(parts)))


def _jpeg(picture: np.ndarray) -> str:
    """As a data URL."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, format="JPEG", quality=82, optimize=True)
    return "data:image/jpeg;base64," + base64.b64encode(stream.getvalue()).decode()

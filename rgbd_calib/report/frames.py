"""The table of frames: what each camera's view was used for, what is left of it, and why a view was left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rgbd_calib.io.residuals import Residuals
from rgbd_calib.quality import Quality
from rgbd_calib.report.numbers import DEPTH, by_view

MAX_ROWS = 2000
"""Of the table: more make the page slow, and nobody reads them."""


@dataclass(frozen=True)
class Cell:
    """One view."""

    state: str
    """used, partly used, left out, no board found."""
    rms_px: float | None = None
    rms_mm: float | None = None
    why: str = ""


@dataclass(frozen=True)
class Frames:
    """Rows by frame, cells by camera; None where there is no image."""

    cameras: tuple[str, ...]
    rows: tuple[tuple[str, tuple[Cell | None, ...]], ...]
    more: int
    """Rows that are not shown: those without a fault."""


def left_out(quality: Quality) -> list[tuple[str, str, str]]:
    """(camera, frame, why) of views that were left out, wholly or in part."""
    rows = []
    for reasons in (quality.views_not_associated, quality.dropped):
        for name, frames in (reasons or {}).items():
            rows += [(name, frame, why) for frame, why in frames.items()]
    for view in quality.plane_filter.dropped_depth if quality.plane_filter is not None else ():
        name, _, frame = view.partition(" ")
        rows.append((name, frame, "depth rejected: it does not lie on the board's plane"))
    return rows


def table(left: Residuals | None, quality: Quality, provenance: Mapping[str, Any], cameras: Sequence[str]) -> Frames:
    """All frames of the recording; those with a fault first where there are too many."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for name, frame, why in left_out(quality):
        reasons.setdefault((name, frame), []).append(why)
    cells: dict[str, dict[str, Cell]] = {}
    images = provenance.get("images_sha256", {})
    for name in cameras:
        for frame in images.get(name, {}) if isinstance(images, Mapping) else ():
            cells.setdefault(str(frame), {})[name] = Cell("no board found")
    for view in by_view(left) if left is not None else []:
        frame, name = view.frame, view.camera
        if frame.startswith(f"{name} alone: ") and name not in cameras:
            continue
        why = "; ".join(reasons.pop((name, frame), ()))
        depth = view.rms_depth_m == view.rms_depth_m
        whole = view.used_depth or not depth if view.used_pixel else name.endswith(DEPTH) and view.used_depth
        some = view.used_pixel or view.used_depth
        state = "used" if whole and not why else "partly used" if some else "left out"
        if not why and state == "partly used":
            why = "depth not used" if view.used_pixel else "depth alone"
        px = view.rms_px if view.rms_px == view.rms_px else None
        cells.setdefault(frame, {})[name] = Cell(state, px, 1e3 * view.rms_depth_m if depth else None, why)
    for (name, frame), whys in reasons.items():
        cells.setdefault(frame, {})[name] = Cell("left out", why="; ".join(whys))
    shown = [name for name in cameras if any(name in row for row in cells.values())]
    order = sorted(cells, key=lambda frame: (" alone: " in frame, frame))
    if len(order) > MAX_ROWS:
        faulty = [f for f in order if any(cell.state != "used" for cell in cells[f].values())]
        order = faulty[:MAX_ROWS]
    rows = tuple((frame, tuple(cells[frame].get(name) for name in shown)) for frame in order)
    return Frames(tuple(shown), rows, len(cells) - len(rows))

"""The report as one HTML file: what it is made of, and the sections in their order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.plain import to_json
from rgbd_calib.io.residuals import Residuals
from rgbd_calib.quality import PairViews, Quality
from rgbd_calib.report import error_map, figures, frames, numbers, sections
from rgbd_calib.report.html import jpeg, page
from rgbd_calib.report.plots import Figure, css_color
from rgbd_calib.report.scene import MovedCloud, scene
from rgbd_calib.report.view_pictures import ViewPicture
from rgbd_calib.trust.verdict import USUAL_M, limits_in
from rgbd_calib.types import Board, Rig

T = TypeVar("T")
MAX_BYTES = 15_000_000
"""Of the page, so that it can be mailed; of larger ones pictures are left out, and that is said."""


@dataclass(frozen=True)
class CloudComparison:
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
    pictures: tuple[CloudComparison, ...] = ()
    cloud_note: str = ""
    missing: Mapping[str, str] = field(default_factory=dict)
    """Sentences by section: images, residuals, clouds."""
    views: tuple[ViewPicture, ...] = ()
    start: Rig | None = None
    """What the calibration started from; None where that is not known."""
    clouds: tuple[MovedCloud, ...] = ()


def render(contents: Contents) -> str:
    """The whole page, with its script, styles and pictures inside, at most `MAX_BYTES` long where that is possible."""
    text = _render(contents)
    for name, less in (("images", {"views": ()}), ("clouds", {"pictures": ()})):
        if len(text.encode("utf-8", "surrogateescape")) <= MAX_BYTES:
            break
        said = f"Pictures are left out: with them the page is longer than {MAX_BYTES // 1_000_000} MB."
        contents = replace(contents, missing={**contents.missing, name: said}, **less)  # type: ignore[arg-type]
        text = _render(contents)
    return text


def _render(contents: Contents) -> str:
    rig, quality, left = contents.rig, contents.rig.quality, contents.residuals
    board = quality.board
    placed = numbers.placed_views_of_rig(rig, left)
    sensors = numbers.sensors_of(rig, left)
    at_m = usual_distance_m(rig, left)
    drawn: dict[str, Figure] = {"scene": _scene(contents, board)}
    verdict = numbers.verdict_of(rig, left)
    if quality.pairs:
        drawn["pairs"] = figures.pair_graph(_paired(rig, quality.pairs), quality.pairs)
    sections.rounds(drawn, rig, at_m)
    return page(
        "report.html",
        drawn,
        title=contents.title,
        rig=rig,
        quality=quality,
        provenance=rig.provenance,
        verdict=verdict,
        words=sections.verdict_words(verdict, list(rig.cameras)),
        limits=_limits(rig),
        colors={own.name: css_color(i) for i, own in enumerate(sensors)},
        images=sections.images(drawn, contents.views),
        volume=sections.volume(drawn, rig),
        slider=bool(contents.clouds) or contents.start is not None,
        pictures=[(p.view, jpeg(p.before)[0], jpeg(p.after)[0]) for p in contents.pictures],
        cloud_note=contents.cloud_note,
        poses=_poses(rig),
        covered=sections.coverage(drawn, rig, placed) if placed is not None else None,
        pairs=_pair_rows(quality),
        cameras=sections.cameras(drawn, rig, left, contents.start, at_m),
        board=board,
        sheets=sections.board_print(drawn, board),
        left=sections.residuals(drawn, sensors, left, placed or []) if left is not None else None,
        frames=frames.table(left, quality, rig.provenance, [own.name for own in sensors]),
        at_m=at_m,
        missing=contents.missing,
        config=to_json(rig.provenance.get("config", {}), indent=1),
    )


def usual_distance_m(rig: Rig, left: Residuals | None) -> float:
    """Where what changes with distance is shown: the working distance, else the median depth, to half a metre."""
    if rig.quality.working_distance_m is not None:
        return max(0.5, round(2 * rig.quality.working_distance_m) / 2)
    used = left.depth_m[left.used_depth] if left is not None else np.empty(0)
    return max(0.5, round(2 * float(np.median(used))) / 2) if len(used) else USUAL_M


def _limits(rig: Rig) -> dict[str, float]:
    own, at_m = limits_in(rig.provenance), rig.quality.working_distance_m or USUAL_M
    return {"good": own.good_mm(at_m), "fair": own.fair_mm(at_m), "noise": own.noise_factor, "at_m": at_m}


def _scene(contents: Contents, board: Board | None) -> Figure:
    rig = contents.rig
    points_m, error_mm = error_map.points_of(rig.quality)
    in_world = se3.transform(rig.cameras[rig.reference].T_world_color, points_m)
    return scene(rig, contents.boards, board, in_world, error_mm, contents.start, contents.clouds)


def _paired(rig: Rig, pairs: Sequence[PairViews]) -> list[str]:
    """The rig's cameras, and then others that pairs name, as depth cameras."""
    named = [name for pair in pairs for name in pair.cameras]
    return list(dict.fromkeys([*rig.cameras, *named]))


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
            }
        )
    return rows


def _of_pair(by_pair: Mapping[str, T], a: str, b: str) -> T | None:
    return by_pair.get(f"{a} - {b}", by_pair.get(f"{b} - {a}"))


def _pair_rows(quality: Quality) -> list[dict[str, Any]]:
    expected = quality.expected_alignment.pairs if quality.expected_alignment is not None else {}
    measured = quality.alignment_on_recording.pairs if quality.alignment_on_recording is not None else {}
    rows = []
    for pair in quality.pairs or ():
        a, b = pair.cameras
        rows.append({"views": pair, "expected": _of_pair(expected, a, b), "measured": _of_pair(measured, a, b)})
    return rows

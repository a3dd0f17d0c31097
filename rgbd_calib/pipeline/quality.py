"""What a calibration says of its way, as plain numbers for the rig file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbd_calib.io.recording import Recording
from rgbd_calib.pipeline.evaluate import Evaluation
from rgbd_calib.pipeline.properties import properties_of
from rgbd_calib.rig.biobjective import RefinementResult
from rgbd_calib.rig.initialization import InitializationResult
from rgbd_calib.rig.solution import Solution
from rgbd_calib.types import PlacedView

if TYPE_CHECKING:
    from rgbd_calib.pipeline.calibrate import Views


def refinement_quality(refined: RefinementResult) -> dict[str, Any]:
    """What the refinement says of itself, as plain numbers."""
    return {
        "status": refined.status,
        "message": refined.message,
        **finite(
            {
                "sigma_2d_px": refined.sigma_2d_px,
                "sigma_3d_m": refined.sigma_3d_m,
                "w": refined.w,
                "redundancy_2d": refined.redundancy_2d,
                "redundancy_3d": refined.redundancy_3d,
                "cost": refined.cost,
            }
        ),
        "iterations": refined.iterations,
        "rounds": [
            finite({"w": r.w, "sigma_2d_px": r.sigma_2d_px, "sigma_3d_m": r.sigma_3d_m, "cost": r.cost})
            for r in refined.history
        ],
        "dropped_rows": refined.dropped,
    }


def bundle_quality(solved: Solution) -> dict[str, Any]:
    return {
        "status": "converged" if solved.course.converged else "max_rounds",
        "message": solved.course.message,
        "cost": solved.cost,
        "iterations": solved.course.iterations,
        "rounds": [
            {
                "cost": r.cost,
                "sigma_2d_px": dict(zip(solved.cameras, r.sigma_2d_px, strict=True)),
                "depth_k_per_m": dict(zip(solved.cameras, r.k_depth, strict=True)),
                "depth_cell_exponent": r.cell_exponent,
                "pose_part_pixel": r.ratio_pixel,
                "pose_part_depth": r.ratio_depth,
                "dropped_views": r.dropped_views,
            }
            for r in solved.course.history
        ],
        "dropped": _by_camera(solved.course.dropped),
        "dropped_depth_corners": solved.course.dropped_depth_corners,
        "not_observable": list(solved.observability.sentences),
        "reciprocal_condition": solved.observability.reciprocal_condition,
        "corrected": properties_of(solved),
        **({"board_bow_m": solved.state.values["bow"][0]} if "bow" in solved.state.values else {}),
        "common_error_sigmas": {
            "pixel": solved.common.pixel,
            "depth": solved.common.depth,
            "depth_over_image": solved.common.depth_image,
        },
    }


def common_quality(
    recording: Recording, views: Views, placed: Sequence[PlacedView], evaluation: Evaluation | None
) -> dict[str, Any]:
    """What is said of a calibration by any method; `placed` are the views with the boards where the rig has them."""
    found, association = views.detections, views.association
    used = {name: sum(p.view.camera == name for p in association.views) for name in recording.cameras}
    out: dict[str, Any] = {
        "images": {name: len(files or recording.depth_files[name]) for name, files in recording.color_files.items()},
        "views_found": {name: len(found.of(name)) for name in recording.cameras},
        "views_used": used,
        "views_not_associated": _by_camera(association.dropped),
        "turned_views": _by_camera({(p.view.camera, p.view.frame): "half turn" for p in association.views if p.turned}),
        "back_views": sum(p.back for p in association.views),
        "plane_filter": {
            "dropped_corners": views.filtered.dropped_corners,
            "dropped_depth": [f"{camera} {frame}" for camera, frame in views.filtered.dropped_views],
        },
        "pairs": [
            {"cameras": list(p.cameras), "common_frames": p.frames, "agreeing": p.votes, "rival": p.rival_votes}
            for p in association.pairs
        ],
        "working_distance_m": round(float(np.median([p.T_color_board[2, 3] for p in placed])), 3),
    }
    choices = {name: own.choice for name, own in views.lenses.results.items()}
    if chosen := {name: asdict(choice) for name, choice in choices.items() if choice.held_out_px}:
        out["lenses"] = chosen
    if evaluation is not None:
        out["alignment_on_recording"] = evaluation.summary()
    return out


def steps_of(start: InitializationResult) -> list[dict[str, Any]]:
    return [{"camera": s.camera, "from": s.from_camera, "points": s.points, "method": s.method} for s in start.steps]


def _by_camera(reasons: Mapping[tuple[str, str], str]) -> dict[str, dict[str, str]]:
    out: dict[str, dict[str, str]] = {}
    for (camera, frame), why in sorted(reasons.items()):
        out.setdefault(camera, {})[frame] = why
    return out


def finite(numbers: Mapping[str, float]) -> dict[str, float]:
    return {key: value for key, value in numbers.items() if np.isfinite(value)}

"""What a calibration says of its way, for the rig file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from rgbd_calib.io.recording import Recording
from rgbd_calib.pipeline.evaluate import Evaluation
from rgbd_calib.pipeline.properties import properties_of
from rgbd_calib.quality import (
    CommonErrorSigmas,
    InitialStep,
    PairViews,
    PlaneFilterCounts,
    Quality,
    WeightRound,
)
from rgbd_calib.rig.biobjective import RefinementResult
from rgbd_calib.rig.initialization import InitializationResult
from rgbd_calib.rig.solution import Solution
from rgbd_calib.types import PlacedView

if TYPE_CHECKING:
    from rgbd_calib.pipeline.checked_views import Views


def initial_quality(start: InitializationResult, refined: RefinementResult | None = None) -> Quality:
    """Of the first poses, and of the refinement that followed."""
    steps = tuple(InitialStep(s.camera, s.from_camera, s.points, s.method) for s in start.steps)
    if refined is None:
        return Quality(initialization=steps)
    return Quality(
        initialization=steps,
        status=refined.status,
        message=refined.message,
        sigma_2d_px=finite(refined.sigma_2d_px),
        sigma_3d_m=finite(refined.sigma_3d_m),
        w=finite(refined.w),
        redundancy_2d=finite(refined.redundancy_2d),
        redundancy_3d=finite(refined.redundancy_3d),
        cost=finite(refined.cost),
        iterations=refined.iterations,
        rounds=tuple(
            WeightRound(finite(r.cost), finite(r.w), finite(r.sigma_2d_px), finite(r.sigma_3d_m))
            for r in refined.history
        ),
        dropped_rows=refined.dropped,
    )


def bundle_quality(solved: Solution) -> Quality:
    rounds = (
        WeightRound(
            cost=r.cost,
            sigma_2d_px=dict(zip(solved.cameras, r.sigma_2d_px, strict=True)),
            depth_k_per_m=dict(zip(solved.cameras, r.k_depth, strict=True)),
            depth_cell_exponent=r.cell_exponent,
            pose_part_pixel=r.ratio_pixel,
            pose_part_depth=r.ratio_depth,
            dropped_views=r.dropped_views,
        )
        for r in solved.course.history
    )
    return Quality(
        status="converged" if solved.course.converged else "max_rounds",
        message=solved.course.message,
        cost=solved.cost,
        iterations=solved.course.iterations,
        rounds=tuple(rounds),
        dropped=_by_camera(solved.course.dropped),
        dropped_depth_corners=solved.course.dropped_depth_corners,
        not_observable=solved.observability.sentences,
        reciprocal_condition=solved.observability.reciprocal_condition,
        corrected=properties_of(solved),
        board_bow_m=solved.state.values["bow"][0] if "bow" in solved.state.values else None,
        common_error_sigmas=CommonErrorSigmas(solved.common.pixel, solved.common.depth, solved.common.depth_image),
    )


def with_views(
    quality: Quality, recording: Recording, views: Views, placed: Sequence[PlacedView], evaluation: Evaluation | None
) -> Quality:
    """With what is said of a calibration by any method; `placed` are the views with the boards where the rig has them."""
    found, association = views.detections, views.association
    lenses = {name: own.choice for name, own in views.lenses.results.items() if own.choice.held_out_px}
    return replace(
        quality,
        images={name: len(files or recording.depth_files[name]) for name, files in recording.color_files.items()},
        views_found={name: len(found.of(name)) for name in recording.cameras},
        views_used={name: sum(p.view.camera == name for p in association.views) for name in recording.cameras},
        views_not_associated=_by_camera(association.dropped),
        turned_views=_by_camera({(p.view.camera, p.view.frame): "half turn" for p in association.views if p.turned}),
        back_views=sum(p.back for p in association.views),
        plane_filter=PlaneFilterCounts(
            views.filtered.dropped_corners,
            tuple(f"{camera} {frame}" for camera, frame in views.filtered.dropped_views),
        ),
        pairs=tuple(PairViews(p.cameras, p.frames, p.votes, p.rival_votes) for p in association.pairs),
        working_distance_m=round(float(np.median([p.T_color_board[2, 3] for p in placed])), 3),
        lenses=lenses or None,
        alignment_on_recording=None if evaluation is None else evaluation.summary(),
    )


def _by_camera(reasons: Mapping[tuple[str, str], str]) -> dict[str, dict[str, str]]:
    out: dict[str, dict[str, str]] = {}
    for (camera, frame), why in sorted(reasons.items()):
        out.setdefault(camera, {})[frame] = why
    return out


def finite(number: float) -> float | None:
    return number if np.isfinite(number) else None

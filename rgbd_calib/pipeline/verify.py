"""Does a rig still hold? A few new frames of the board, against the rig's poses, lenses and depth biases as they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.recording import Recording
from rgbd_calib.io.text import first_few
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.rig_inputs import board_for, common_cameras
from rgbd_calib.quality import WeightRound
from rgbd_calib.trust.displacement import (
    DisplacementVerdict,
    FittedView,
    LocatedCameras,
    ObservationNoise,
    VerdictParams,
    fit_view,
    joined_to,
    judge,
    locate_cameras,
)
from rgbd_calib.types import Board, BoardView, PlacedView, PosedView, Rig
from rgbd_calib.views.association import associate, label_views
from rgbd_calib.views.board_pose import pose_view
from rgbd_calib.views.plane_filter import filter_planes

_MIN_PLANES = 4
"""Views with depth that are needed to say how far depth is off over whole boards."""
_CHI2_3_MEDIAN = 2.366
"""Median of chi squared with 3 degrees of freedom."""


@dataclass(frozen=True)
class Verification:
    """The verdict and what it rests on."""

    verdict: DisplacementVerdict
    poses: LocatedCameras
    left_out: dict[tuple[str, str], str]
    """Why, by (camera, frame), of views that fit nothing."""

    @property
    def holds(self) -> bool:
        """The rig is still valid."""
        return self.verdict.holds

    def __str__(self) -> str:
        return sentence(self.verdict)


@one_blas_thread
def verify(
    rig: Rig, recording: Recording, views: Sequence[BoardView], config: Config, params: VerdictParams
) -> Verification:
    """Compare the rig with new views of the board by the cameras that both have.

    Raises
    ------
    CalibrationError
        No two cameras see the board in the same frame.
    """
    cameras = common_cameras(recording, rig)
    return verify_views(rig, views, board_for(recording, rig), cameras, config, params)


@one_blas_thread
def verify_views(
    rig: Rig, views: Sequence[BoardView], board: Board, cameras: Sequence[str], config: Config, params: VerdictParams
) -> Verification:
    """The same on detected corners."""
    mine = [view for view in views if view.camera in cameras]
    seen = [(view.camera, view.frame) for view in mine]
    anchor = max(cameras, key=lambda name: (len(joined_to(name, seen)), name == rig.reference))
    if len(joined_to(anchor, seen)) < 2:
        raise CalibrationError(
            f"no frame shows the board to two of the cameras {', '.join(cameras)}; nothing to compare. Hold the board where "
            "two cameras see it, five frames for each pair are good"
        )
    posed = _posed(rig, mine, board, config)
    placed, left_out, T_world_color = _label(rig, posed, board, cameras, anchor, config)
    fitted = fit_views(rig, placed, board)
    poses = replace(
        locate_cameras(fitted, T_world_color, anchor),
        before={name: rig.cameras[name].T_world_color for name in cameras},
    )
    return Verification(judge(poses, cameras, params), poses, left_out)


def summary(result: Verification) -> dict[str, Any]:
    """Plain numbers and the verdict in words."""
    verdict = result.verdict
    return {
        "holds": verdict.holds,
        "verdict": sentence(verdict),
        "moved": list(verdict.moved),
        "or_else": [list(names) for names in verdict.rivals],
        "not_checked": list(verdict.unjoined),
        "pairs": {
            " - ".join(p.cameras): {"error_mm": 1e3 * p.error_m, "noise_mm": 1e3 * p.noise_m, "off": p.broken}
            for p in verdict.pairs
        },
        "cameras": {
            m.camera: {
                "shift_mm": 1e3 * m.shift_m,
                "shift_sd_mm": 1e3 * m.shift_sd_m,
                "turn_deg": float(np.degrees(m.turn_rad)),
                "turn_sd_deg": float(np.degrees(m.turn_sd_rad)),
            }
            for m in verdict.displacements
        },
        "frames": len(result.poses.T_world_board),
        "views_left_out": [
            f"{camera}: frame {frame} left out: {why}" for (camera, frame), why in result.left_out.items()
        ],
    }


def sentence(verdict: DisplacementVerdict) -> str:
    """The verdict, and what to do."""
    limit = f"{1e3 * verdict.max_m:g} mm"
    if verdict.moved:
        names = " and ".join(verdict.moved)
        first = f"FAIL: {names} moved"
        if verdict.rivals:
            others = ", or ".join(" and ".join(r) for r in verdict.rivals)
            first = f"FAIL: {names}, or {others}, moved: these frames cannot tell which"
            first += ", since there are only two cameras" if len(verdict.pairs) == 1 else ""
        return f"{first}. Calibrate anew, or re-pose it: rgbd-calib calibrate RECORDING --update RIG --only {verdict.moved[0]}"
    if verdict.unjoined:
        return (
            f"UNDECIDED: {', '.join(verdict.unjoined)} saw no board together with the others. Hold the board where another "
            "camera sees it too, five frames for each"
        )
    if verdict.blind:
        pairs = first_few([" - ".join(pair) for pair in verdict.blind])
        return (
            f"UNDECIDED: the noise of these frames hides an error of {limit} between {pairs}. Film more frames of the board, "
            "near to these cameras and tilted differently, or allow more with --max-mm"
        )
    worst = max(verdict.pairs, key=lambda p: p.error_m)
    return (
        f"PASS: the rig holds; the worst pair, {' - '.join(worst.cameras)}, is off by {1e3 * worst.error_m:.2f} mm "
        f"at the board, {limit} allowed"
    )


def fit_views(rig: Rig, placed: Sequence[PlacedView], board: Board) -> tuple[FittedView, ...]:
    """The board's pose in every view, by weights that the views' own residuals give."""
    common = _common_noise(rig)

    def fit(view: PlacedView, noise: ObservationNoise) -> FittedView:
        own = rig.cameras[view.view.camera]
        return fit_view(view, board, own.intrinsics, own.depth_sensor, noise)

    first = [fit(view, common) for view in placed]
    planes = np.array([v.plane_sigmas for v in first])
    planes = planes[np.isfinite(planes)]
    if len(planes) >= _MIN_PLANES:
        ratio = float(np.sqrt(np.median(planes**2) / _CHI2_3_MEDIAN))
        common = replace(common, ratio_depth=max(ratio, 1.0))
    noise = {name: _noise_of([v for v in first if v.placed.view.camera == name], common) for name in rig.cameras}
    return tuple(fit(replace(v.placed, T_color_board=v.T_color_board), noise[v.placed.view.camera]) for v in first)


def _posed(rig: Rig, views: Sequence[BoardView], board: Board, config: Config) -> list[PosedView]:
    lenses = {name: own.intrinsics for name, own in rig.cameras.items()}
    biases = {name: own.depth_bias for name, own in rig.cameras.items() if own.depth_bias is not None}
    filtered = filter_planes(views, lenses, biases, config.plane_filter, config.seed)
    return [pose_view(v, board, lenses[v.camera], biases.get(v.camera), config.board_pose) for v in filtered.views]


def _label(
    rig: Rig, posed: Sequence[PosedView], board: Board, cameras: Sequence[str], anchor: str, config: Config
) -> tuple[tuple[PlacedView, ...], dict[tuple[str, str], str], Mapping[str, FloatArray]]:
    """Face and turn of every view by the rig's poses; where a camera moved so far that this fails, from scratch."""
    T_world_color = {name: rig.cameras[name].T_world_color for name in cameras}
    placed, left_out = label_views(posed, board, T_world_color, config.association)
    seen = [(p.view.camera, p.view.frame) for p in posed]
    joined = joined_to(anchor, seen)
    lost = joined - joined_to(anchor, [(p.view.camera, p.view.frame) for p in placed])
    if not lost and 2 * len(left_out) < len(posed):
        return placed, left_out, T_world_color
    mine = [p for p in posed if p.view.camera in joined]
    again = associate(mine, board, anchor, [name for name in cameras if name in joined], config.association)
    moved = {name: T_world_color[anchor] @ T for name, T in again.T_world_color.items()}
    return again.views, again.dropped, T_world_color | moved


def _common_noise(rig: Rig) -> ObservationNoise:
    """What the rig's own calibration says of errors that a whole view shares; else the defaults."""
    last, default = (rig.quality.rounds or (WeightRound(),))[-1], ObservationNoise()
    pixel, depth = last.pose_part_pixel, last.pose_part_depth
    return replace(
        default,
        ratio_pixel=default.ratio_pixel if pixel is None else max(pixel, 1.0),
        ratio_depth=default.ratio_depth if depth is None else max(depth, 1.0),
    )


def _noise_of(fitted: Sequence[FittedView], common: ObservationNoise) -> ObservationNoise:
    if not fitted:
        return common
    k = np.array([v.k_depth_per_m for v in fitted])
    k = k[np.isfinite(k)]
    return replace(
        common,
        sigma_2d_px=max(float(np.median([v.sigma_2d_px for v in fitted])), 0.01),
        k_depth_per_m=max(float(np.median(k)), 1e-5) if len(k) else common.k_depth_per_m,
    )

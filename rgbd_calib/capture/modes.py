"""The ways to record: at intervals, whenever the board is still, camera by camera, at known distances."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from rgbd_calib.capture.board_watch import DetectedFrameSet
from rgbd_calib.capture.stillness import StillBoard, StillParams
from rgbd_calib.capture.studio import Studio
from rgbd_calib.views.coverage import CoverageParams

LOOK_PERIOD_S = 0.15
"""Between two looks for the board: often enough to feel live, and the cameras' readers keep the processor."""


@dataclass(frozen=True)
class ModeParams:
    """When a shot is taken, and when it is enough."""

    interval_s: float = 0.5
    count: int | None = None
    """Shots: of the rig, of each camera with `record_intrinsics`, at each distance with `record_depth_bias`."""
    on_still: bool = False
    until_enough: bool = False
    still: StillParams = field(default_factory=StillParams)


def record_rig(studio: Studio, params: ModeParams) -> None:
    """Shots of all cameras together."""
    _record(studio, params, None)


def record_intrinsics(studio: Studio, params: ModeParams, coverage: CoverageParams) -> None:
    """Shots of one camera after the other, each until it has enough, or `params.count`."""
    for camera in studio.rig.cameras:
        studio.guide.judge([camera], replace(coverage, judge_pairs=False))
        studio.note(camera, f"now {camera}: hold the board close in front of it, in all corners of the image, tilted")
        _record(studio, params, camera)
    studio.guide.judge(studio.rig.cameras, replace(coverage, judge_pairs=False))


def record_depth_bias(
    studio: Studio,
    params: ModeParams,
    distances_m: Sequence[float],
    ask: Callable[[str, float | None], float | None],
) -> None:
    """Shots of a wall at known distances, one camera after the other.

    Parameters
    ----------
    distances_m
        The distances to go through; empty: `ask` says them.
    ask
        Called with (camera, proposed distance or None) before each distance; gives the distance in metres, or None
        to go on with the next camera.
    """
    count = params.count or 5
    for camera in studio.rig.cameras:
        proposals = list(distances_m)
        while True:
            proposed = proposals.pop(0) if proposals else None
            if distances_m and proposed is None:
                break
            distance_m = ask(camera, proposed)
            if distance_m is None:
                break
            studio.guide.advise(f"{camera}: {count} shots of the wall at {distance_m:.3f} m; do not move")
            for _ in range(count):
                studio.record(studio.frame_set(camera), {}, distance_m)
                studio.pause(params.interval_s)


def _record(studio: Studio, params: ModeParams, only: str | None) -> None:
    if params.on_still:
        _record_when_still(studio, params, only)
    else:
        _record_at_intervals(studio, params, only)


def _record_at_intervals(studio: Studio, params: ModeParams, only: str | None) -> None:
    next_s, taken = time.monotonic(), 0
    studio.guide.advise("hold the board still at each shot" if studio.finder else "recording")
    while not _finished(studio, params, taken):
        _look_until(studio, next_s, only)
        next_s = max(next_s + params.interval_s, time.monotonic())
        studio.record(studio.frame_set(only), None)
        taken += 1


def _look_until(studio: Studio, until_s: float, only: str | None) -> None:
    """Wait, and meanwhile show where the board is."""
    while (left_s := until_s - time.monotonic()) > 0:
        if studio.finder and left_s > 3 * LOOK_PERIOD_S:
            studio.look(only)
        studio.pause(min(LOOK_PERIOD_S, until_s - time.monotonic()))
    studio.check()


def _record_when_still(studio: Studio, params: ModeParams, only: str | None) -> None:
    still, taken = StillBoard(params.still), 0
    before: DetectedFrameSet | None = None
    while not _finished(studio, params, taken):
        look = studio.look(only)
        due = still.look(look.frame_set.time_s, look.corners)
        if due and _take_still_shot(studio, still, before or look, look, only):
            still.taken()
            taken += 1
        studio.guide.advise(_still_advice(still, look, only))
        before = look
        studio.pause(LOOK_PERIOD_S)


def _take_still_shot(
    studio: Studio, still: StillBoard, before: DetectedFrameSet, now: DetectedFrameSet, only: str | None
) -> bool:
    """Record the look before this one, which was still on both sides; or take depth now and look again after it."""
    if studio.photographer.instantaneous:
        studio.record(before.frame_set, before.corners)
        return True
    images = studio.photographer.images(now.frame_set)
    after = studio.look(only)
    still.look(after.frame_set.time_s, after.corners)
    if not still.is_still:
        studio.tally.moved += 1
        studio.guide.event("the board moved during the shot; hold it again")
        return False
    studio.write(now.frame_set, images, now.corners)
    return True


def _still_advice(still: StillBoard, look: DetectedFrameSet, only: str | None) -> str:
    if not look.corners:
        return f"hold the board where {only or 'a camera'} sees it"
    if still.waits_for_new_pose:
        return "taken; now hold the board somewhere else"
    return "hold still"


def _finished(studio: Studio, params: ModeParams, taken: int) -> bool:
    coverage = studio.guide.coverage
    if studio.expected is not None and coverage is not None:
        studio.expected.update(studio.writer.finished, coverage)
        if studio.expected.course.reached:
            return True
    if params.count is not None and taken >= params.count:
        return True
    return params.until_enough and coverage is not None and coverage.enough

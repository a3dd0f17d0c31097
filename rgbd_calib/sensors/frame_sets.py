"""One instant over free-running cameras: the frames whose exposures lie closest together.

Cameras that nobody synchronises expose at phases of their own. Over one period, N of them leave a largest gap of at
least period / N, so exposures that span at most period * (1 - 1 / N) can always be had, by starting after that gap.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rgbd_calib.sensors.frames import PERIOD_S, FrameSet, RgbdFrame

MAX_SPREAD_S = PERIOD_S
"""Sets that span more are refused: frames of that kind are missing in between."""


def tightest_frame_set(frames: Mapping[str, Sequence[RgbdFrame]], after_s: float) -> FrameSet | None:
    """The frame set with the smallest spread that starts within one period after `after_s`.

    Parameters
    ----------
    frames
        Recent frames of each camera, oldest first.

    Returns
    -------
    None while some camera's frames do not reach far enough to decide.
    """
    later = {camera: [f for f in recent if f.color_s >= after_s] for camera, recent in frames.items()}
    if not later or any(not recent for recent in later.values()):
        return None
    starts = sorted(f.color_s for recent in later.values() for f in recent if f.color_s < after_s + PERIOD_S)
    best: FrameSet | None = None
    for start_s in starts or [after_s]:
        chosen = {c: next((f for f in recent if f.color_s >= start_s), None) for c, recent in later.items()}
        whole = {c: f for c, f in chosen.items() if f is not None}
        if len(whole) < len(chosen):
            break
        times_s = [f.color_s for f in whole.values()]
        spread_s = max(times_s) - min(times_s)
        if best is None or spread_s < best.spread_s:
            best = FrameSet(whole, spread_s)
    decided = all(recent[-1].color_s >= after_s + PERIOD_S for recent in later.values())
    return best if decided else None

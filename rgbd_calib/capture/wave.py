"""Recording while the board is carried: every frame of every camera, as it comes, with its own stamps."""

from __future__ import annotations

import time

import numpy as np

from rgbd_calib.capture.board_watch import DetectedFrameSet
from rgbd_calib.capture.studio import Studio
from rgbd_calib.sensors.frames import PERIOD_S, FrameSet

LOOK_S = 0.4
"""Between two looks for the board: the disk and the readers come first."""
TOO_FAST_PX_S = 400.0
"""Of the corners: 6 ms of exposure blur them over more than two pixels."""


def record_wave(studio: Studio, seconds: float) -> None:
    """All frames of `seconds` seconds; frames that come while the disk is busy are dropped.

    Raises
    ------
    Stopped, CalibrationError
        As for :meth:`rgbd_calib.capture.studio.Studio.frame_set`.
    """
    start_s = time.monotonic()
    written = dict.fromkeys(studio.rig.cameras, start_s)
    looked_s, n_looks, before, last_s = start_s, 0, None, start_s
    studio.guide.advise("carry the board through the volume, turn it about all axes, stop now and then")
    while (now_s := time.monotonic()) < start_s + seconds:
        studio.check()
        fresh = 0
        for camera in studio.rig.live_cameras:
            for frame in studio.rig.reader(camera).pairs():
                if frame.color_s > written[camera]:
                    written[camera] = frame.color_s
                    alone = FrameSet({camera: frame}, 0.0)
                    studio.write(alone, studio.photographer.images(alone), {})
                    fresh += 1
        studio.guide.seen_live(studio.rig.live_cameras)
        last_s = now_s if fresh else last_s
        if now_s - last_s > studio.give_up_s:
            studio.frame_set()  # which says what is missing, or finds that they deliver again
        if studio.finder and now_s - looked_s > LOOK_S and studio.rig.live_cameras:
            looked_s, n_looks = now_s, n_looks + 1
            look = studio.look()
            sizes = {c: f.color.pixels.shape[1::-1] for c, f in look.frame_set.frames.items()}
            studio.guide.recorded(f"look {n_looks}", look.corners, sizes)
            studio.guide.advise(_advice(look, before))
            before = look
        if not fresh:
            studio.pause(PERIOD_S / 4)


def _advice(look: DetectedFrameSet, before: DetectedFrameSet | None) -> str:
    if not look.corners:
        return "no camera sees the board: bring it back, or carry it more slowly"
    if len(look.corners) < 2 and len(look.frame_set.frames) > 1:
        return "one camera alone sees the board: carry it where two do"
    if before is not None and _speed_px_s(look, before) > TOO_FAST_PX_S:
        return "too fast: the images are blurred; carry it more slowly"
    return "good: go on, turn it about all axes, near and far, stop now and then"


def _speed_px_s(look: DetectedFrameSet, before: DetectedFrameSet) -> float:
    """Median speed of the corners that both looks have, of the fastest camera; 0 where there are none."""
    apart_s, out = max(look.frame_set.time_s - before.frame_set.time_s, 1e-3), 0.0
    for camera in look.corners.keys() & before.corners.keys():
        (ids, px), (ids_before, px_before) = look.corners[camera], before.corners[camera]
        _, here, there = np.intersect1d(ids, ids_before, return_indices=True)
        if len(here):
            out = max(out, float(np.median(np.linalg.norm(px[here] - px_before[there], axis=1))) / apart_s)
    return out

"""Recording while the board is carried: every frame of every camera, as it comes, with its own stamps."""

from __future__ import annotations

import time

import numpy as np

from rgbd_calib.capture.board_watch import DetectedFrameSet
from rgbd_calib.capture.studio import Studio
from rgbd_calib.sensors.frames import PERIOD_S, FrameSet
from rgbd_calib.sensors.reader import DeviceReader

LOOK_S = 0.4
"""Between two looks for the board: the disk and the readers come first."""
PENDING_PAIRS = 60
"""Of each camera, in memory until they are written: two seconds, for disks that pause."""
_TELL_S = 1.0
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
    tracks = {camera: _Track(camera, start_s) for camera in studio.rig.cameras}
    looked_s, n_looks, before, last_s, told_s = start_s, 0, None, start_s, start_s
    studio.guide.advise("carry the board through the volume, turn it about all axes, stop now and then")
    while (now_s := time.monotonic()) < start_s + seconds:
        studio.check()
        fresh = sum(tracks[camera].write_new(studio) for camera in studio.rig.live_cameras)
        studio.guide.seen_live(studio.rig.live_cameras)
        last_s = now_s if fresh else last_s
        if now_s - told_s > _TELL_S:
            told_s = now_s
            studio.guide.written(studio.tally.recorded)
        if now_s - last_s > studio.give_up_s:
            studio.frame_set()  # which says what is missing, or finds that they deliver again
        if studio.finder and now_s - looked_s > LOOK_S and studio.rig.live_cameras:
            looked_s, n_looks = now_s, n_looks + 1
            look = studio.look()
            sizes = {c: f.color.pixels.shape[1::-1] for c, f in look.frame_set.frames.items()}
            studio.guide.known(f"look {n_looks}", look.corners, sizes)
            studio.guide.advise(_advice(look, before))
            before = look
        if not fresh:
            studio.pause(PERIOD_S / 4)


class _Track:
    """What was written of one camera."""

    def __init__(self, camera: str, start_s: float) -> None:
        self._camera, self._until_s = camera, start_s
        self._reader: DeviceReader | None = None
        self._last: tuple[int, int] | None = None
        """Number and colour stamp (us) of the last pair."""

    def write_new(self, studio: Studio) -> int:
        """Write the pairs that came since the last call, and say where some are missing; how many were written."""
        reader, n = studio.rig.reader(self._camera), 0
        if reader is not self._reader:  # plugged in again: numbers begin anew
            self._reader, self._last = reader, None
        for frame in reader.pairs():
            if frame.color_s <= self._until_s:
                continue
            alone = FrameSet({self._camera: frame}, 0.0)
            images = studio.photographer.images(alone)
            stamp_us = images[self._camera].color_us
            assert stamp_us is not None
            if self._last is not None and frame.number > self._last[0] + 1:
                self._drop(studio, frame.number - self._last[0] - 1, self._last[1], stamp_us)
            self._until_s, self._last = frame.color_s, (frame.number, stamp_us)
            studio.queue(alone, images)
            n += 1
        return n

    def _drop(self, studio: Studio, n: int, after_us: int, before_us: int) -> None:
        if not studio.tally.not_written:
            studio.note(
                "", "writing is slower than the cameras: frames are dropped. Close other programs, or use a faster disk"
            )
        gaps = studio.tally.not_written.setdefault(self._camera, [])
        gaps.append({"frames": n, "after_us": after_us, "before_us": before_us})


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

"""One shot: a frame set as it will be written, with the depth taken the way the user asked for."""

from __future__ import annotations

import time
from dataclasses import dataclass

import cv2
import numpy as np

from rgbd_calib.io.growing_recording import CameraImages
from rgbd_calib.sensors.depth_average import mean_depth
from rgbd_calib.sensors.frames import PERIOD_S, FrameSet, SensorFrame
from rgbd_calib.sensors.rig import SensorRig

FRAME_SET_TIMEOUT_S = 3.0
"""Longer than a reader needs to be called stalled: then the set goes on without that camera."""
EMITTER_PAUSE_S = 0.3
"""After a projector was switched: switching takes up to 0.25 s (OpenNI/OpenNI2 issue 23)."""
_DEPTH_TIMEOUT_S = 2.0


@dataclass(frozen=True)
class DepthParams:
    """How depth is taken."""

    frames: int = 1
    """The mean of so many; 1 stores what the device sent."""
    alternate_emitters: bool = False
    """Only one infrared projector shines at a time while its camera's depth is taken."""


class Photographer:
    """Takes shots of a rig; `clock_zero_s` is the recording's zero on the host's monotonic clock."""

    def __init__(self, rig: SensorRig, params: DepthParams, clock_zero_s: float) -> None:
        self._rig = rig
        self._params = params
        self._clock_zero_s = clock_zero_s

    @property
    def instantaneous(self) -> bool:
        """True where a frame set alone makes the shot."""
        return self._params.frames == 1 and not self._params.alternate_emitters

    def frame_set(self, only: str | None = None) -> FrameSet | None:
        """A frame set exposed after this call; None where no camera delivers."""
        return self._rig.next_frame_set(time.monotonic(), FRAME_SET_TIMEOUT_S, only)

    def images(self, frame_set: FrameSet) -> dict[str, CameraImages]:
        """The images to write for `frame_set`: takes the depth frames that its params ask for."""
        depths = {c: [f.depth] for c, f in frame_set.frames.items() if f.depth is not None}
        times_s = {c: f.depth_s for c, f in frame_set.frames.items() if f.depth_s is not None}
        if self._params.alternate_emitters:
            depths = self._depths_in_turns(frame_set)
        elif self._params.frames > 1:
            depths = {c: self._collect(c, since_s) for c, since_s in times_s.items()}
        out = {}
        for camera, frame in frame_set.frames.items():
            taken = depths.get(camera, [])
            if frame.depth is None or not taken:  # it has no depth, or went silent just now: its colour is still good
                out[camera] = CameraImages(_bgr(frame.color.pixels), None, self._us(frame.color_s), None)
                continue
            if taken[0] is not frame.depth:
                times_s[camera] = self._rig.reader(camera).depth_host_s(taken[len(taken) // 2])
            depth_raw = mean_depth([f.pixels for f in taken])
            color_us, depth_us = self._us(frame.color_s), self._us(times_s[camera])
            infrared = frame.depth.infrared
            out[camera] = CameraImages(_bgr(frame.color.pixels), depth_raw, color_us, depth_us, infrared=infrared)
        return out

    def _us(self, host_s: float) -> int:
        return round((host_s - self._clock_zero_s) * 1e6)

    def _collect(self, camera: str, since_s: float) -> list[SensorFrame]:
        """The first depth frames of a camera exposed since `since_s`, as many as asked for or as came in time."""
        wanted = self._params.frames
        deadline_s = time.monotonic() + _DEPTH_TIMEOUT_S + 2 * wanted * PERIOD_S
        while True:
            taken = self._rig.reader(camera).depths_since(since_s)
            if len(taken) >= wanted or time.monotonic() > deadline_s or camera not in self._rig.live_cameras:
                return taken[:wanted]
            time.sleep(PERIOD_S / 2)

    def _depths_in_turns(self, frame_set: FrameSet) -> dict[str, list[SensorFrame]]:
        taken = {}
        cameras = [c for c in frame_set.frames if c in self._rig.live_cameras]
        try:
            for camera in self._rig.live_cameras:
                self._rig.set_emitter(camera, False)
            for camera in cameras:
                self._rig.set_emitter(camera, True)
                time.sleep(EMITTER_PAUSE_S)
                taken[camera] = self._collect(camera, time.monotonic())
                self._rig.set_emitter(camera, False)
        finally:
            for camera in self._rig.live_cameras:
                self._rig.set_emitter(camera, True)
        return {c: taken.get(c, []) for c in frame_set.frames}


def _bgr(rgb: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)

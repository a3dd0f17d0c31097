"""What every mode of recording needs, in one place, and the few moves that they share."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from rgbd_calib.capture.board_watch import BoardFinder, DetectedFrameSet
from rgbd_calib.capture.expected_error import ExpectedError
from rgbd_calib.capture.guide import Guide
from rgbd_calib.capture.shots import Photographer
from rgbd_calib.capture.stillness import Corners
from rgbd_calib.errors import CalibrationError
from rgbd_calib.io.growing_recording import CameraImages
from rgbd_calib.sensors.frames import FrameSet
from rgbd_calib.sensors.rig import SensorRig
from rgbd_calib.sensors.writer import FrameSetWriter

_SLOW_DISK_S = 1.0


@dataclass
class Tally:
    """What became of the frame sets; kept in the capture log."""

    recorded: int = 0
    incomplete: int = 0
    """Recorded without some camera."""
    moved: int = 0
    """Dropped because the board moved while depth was taken."""
    absent: dict[str, int] = field(default_factory=dict)
    """{camera: recorded frame sets without it}."""
    spreads_ms: list[float] = field(default_factory=list)
    not_written: dict[str, list[dict[str, int]]] = field(default_factory=dict)
    """{camera: frames that came and were dropped as writing was slower: how many, and colour stamps of the frames around them}."""


class Stopped(Exception):
    """The user asked for the end."""


@dataclass
class Studio:
    """A running rig and everything around it."""

    rig: SensorRig
    photographer: Photographer
    writer: FrameSetWriter
    guide: Guide
    finder: BoardFinder | None
    stop: threading.Event
    give_up_s: float
    note: Callable[[str, str], None]
    """Tells user and log of an event: (camera or '', text)."""
    tally: Tally = field(default_factory=Tally)
    expected: ExpectedError | None = None
    """Where it decides how long to record."""
    _silent_since_s: float | None = None
    _slow_disk_told: bool = False

    def frame_set(self, only: str | None = None) -> FrameSet:
        """The next frame set, waited for.

        Raises
        ------
        Stopped
            The user asked for the end meanwhile.
        CalibrationError
            No camera has delivered for `give_up_s`, or writing failed.
        """
        while True:
            self.check()
            found = self.photographer.frame_set(only)
            self.guide.seen_live(self.rig.live_cameras)
            if found is not None:
                self._silent_since_s = None
                return found
            now_s = time.monotonic()
            self._silent_since_s = self._silent_since_s or now_s
            if now_s - self._silent_since_s > self.give_up_s:
                raise CalibrationError(
                    f"{only or 'all cameras'}: no frames for {self.give_up_s:.0f} s; what was recorded before is whole. "
                    "Plug it in again, check `rgbd-calib devices`, then resume with --append"
                )

    def check(self) -> None:
        """Raise `Stopped` where the user asked for the end, and what the writers met."""
        self.writer.check()
        if self.stop.is_set():
            raise Stopped

    def pause(self, seconds: float) -> None:
        """Wait, unless the user asks for the end."""
        if self.stop.wait(max(0.0, seconds)):
            raise Stopped

    def look(self, only: str | None = None) -> DetectedFrameSet:
        """A frame set with the board's corners in it."""
        frame_set = self.frame_set(only)
        look = self.finder.look(frame_set) if self.finder else DetectedFrameSet(frame_set, {})
        self.guide.looked(look, self.rig.live_cameras)
        return look

    def record(
        self, frame_set: FrameSet, corners: Mapping[str, Corners] | None, distance_m: float | None = None
    ) -> str:
        """Write a frame set with its depth, and return its name. `corners` None: look for them, if there is a board."""
        images = self.photographer.images(frame_set)
        if distance_m is not None:
            images = {c: replace(shot, distance_m=distance_m) for c, shot in images.items()}
        return self.write(frame_set, images, corners)

    def write(
        self, frame_set: FrameSet, images: Mapping[str, CameraImages], corners: Mapping[str, Corners] | None
    ) -> str:
        """Queue images that were made of a frame set, and count them."""
        frame = self.queue(frame_set, images)
        self._tell_slow_disk()
        if frame_set.absent:
            self.tally.incomplete += 1
            for camera in frame_set.absent:
                self.tally.absent[camera] = self.tally.absent.get(camera, 0) + 1
        if corners is None:
            look = self.finder.look(frame_set) if self.finder else DetectedFrameSet(frame_set, {})
            self.guide.looked(look, self.rig.live_cameras)
            corners = look.corners
        sizes = {c: f.color.pixels.shape[1::-1] for c, f in frame_set.frames.items()}
        self.guide.recorded(frame, corners, sizes)
        return frame

    def queue(self, frame_set: FrameSet, images: Mapping[str, CameraImages]) -> str:
        """Queue images for the disk."""
        frame = self.writer.submit(images, round(frame_set.spread_s * 1e6))
        self.tally.recorded += 1
        self.tally.spreads_ms.append(frame_set.spread_s * 1e3)
        return frame

    def _tell_slow_disk(self) -> None:
        if self.writer.waited_s > _SLOW_DISK_S and not self._slow_disk_told:
            self._slow_disk_told = True
            self.note("", "the disk is slower than the recording: shots come later than asked. Raise --interval")

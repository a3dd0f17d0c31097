"""One thread for each device: reads its streams, pairs them, keeps the last frames, and notices silence."""

from __future__ import annotations

import threading
import time
from collections import deque
from concurrent.futures import Future, wait
from dataclasses import dataclass
from typing import Protocol

from rgbd_calib.errors import CalibrationError, RgbdCalibError
from rgbd_calib.sensors.clock import DeviceClock
from rgbd_calib.sensors.frames import Kind, RgbdFrame, SensorFrame
from rgbd_calib.sensors.lasting_threads import run_lasting
from rgbd_calib.sensors.pairing import ColorAlone, ColorDepthPairer

STALLED_AFTER_S = 1.0
_JUMP_S = 2.0
"""Between what a device's clock and the host's say of the time from frame to frame: more than any queue holds back."""
_WAIT_S = 0.2
_JOIN_S = 2.0
KEEP_PAIRS = 8
"""Pairs kept for each device: enough to look back over two periods for the tightest frame set."""
KEEP_EVERY_PAIR = 30
"""Pairs kept where every one is wanted: a second of them, for as long as whoever takes them may be busy otherwise."""


class FrameSource(Protocol):
    """What a reader needs of a device."""

    @property
    def sizes(self) -> dict[Kind, tuple[int, int]]: ...

    def wait_frame(self, timeout_s: float) -> SensorFrame | None: ...


@dataclass(frozen=True)
class ReaderCounts:
    """What one device delivered so far."""

    frames: dict[Kind, int]
    lost: dict[Kind, int]
    unpaired: dict[Kind, int]
    pairs: int


class DeviceReader:
    """Reads one device for as long as it is open.

    `fresh` is notified at every pair; readers of one rig share it.
    """

    def __init__(
        self,
        camera: str,
        device: FrameSource,
        fresh: threading.Condition,
        keep_depth: int = 1,
        keep_pairs: int = KEEP_PAIRS,
    ) -> None:
        self.camera = camera
        self._device = device
        self._fresh = fresh
        self._clock = DeviceClock()
        kinds: list[Kind] = sorted(device.sizes)  # colour first, in messages too
        self._pairer = ColorDepthPairer() if "depth" in device.sizes else ColorAlone()
        self._pairs: deque[RgbdFrame] = deque(maxlen=keep_pairs)
        self._depths: deque[SensorFrame] = deque(maxlen=max(1, keep_depth))
        self._frames: dict[Kind, int] = dict.fromkeys(kinds, 0)
        self._n_pairs = 0
        self._last: dict[Kind, SensorFrame] = {}
        self._jumps = 0
        self._last_s: dict[Kind, float] = dict.fromkeys(kinds, time.monotonic())
        self._failure: str | None = None
        self._stop = threading.Event()
        self._running: Future[None] | None = None

    def start(self) -> None:
        self._running = run_lasting(self._run)

    def stop(self) -> bool:
        """Ask the thread to end and wait for it; False where it hangs in the runtime."""
        self._stop.set()
        return self._running is None or bool(wait([self._running], _JOIN_S).done)

    @property
    def failure(self) -> str | None:
        """Why the thread ended by itself, if it did."""
        return self._failure

    @property
    def jumps(self) -> int:
        """How often the device's clock jumped, as one does that is set anew."""
        return self._jumps

    def silent_kinds(self) -> tuple[Kind, ...]:
        """Streams that have delivered nothing for `STALLED_AFTER_S`."""
        now_s = time.monotonic()
        return tuple(kind for kind, last_s in self._last_s.items() if now_s - last_s > STALLED_AFTER_S)

    def pairs(self) -> list[RgbdFrame]:
        """The last pairs, oldest first."""
        with self._fresh:
            return list(self._pairs)

    def depths_since(self, host_s: float) -> list[SensorFrame]:
        """Depth frames kept that were exposed at `host_s` or later, oldest first."""
        with self._fresh:
            return [f for f in self._depths if self._clock.host_s(f.device_us) >= host_s]

    def depth_host_s(self, frame: SensorFrame) -> float:
        """Exposure time of a depth frame on the host's clock."""
        return self._clock.host_s(frame.device_us)

    def counts(self) -> ReaderCounts:
        with self._fresh:
            return ReaderCounts(dict(self._frames), dict(self._pairer.lost), dict(self._pairer.unpaired), self._n_pairs)

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                frame = self._device.wait_frame(_WAIT_S)
                if frame is not None:
                    self._take(frame)
        except RgbdCalibError as error:
            self._failure = str(error)
        except Exception as error:  # the runtime may raise anything when a device dies; the rig's watch reports it
            self._failure = f"{type(error).__name__}: {error}"

    def _take(self, frame: SensorFrame) -> None:
        height, width = frame.pixels.shape[:2]
        if (width, height) != self._device.sizes[frame.kind]:
            wanted = "{}x{}".format(*self._device.sizes[frame.kind])
            raise CalibrationError(
                f"{frame.kind} of {wanted} px was set up, {width}x{height} px came. Replug the camera"
            )
        with self._fresh:
            if self._jumped(frame):
                self._clock, self._jumps = DeviceClock(), self._jumps + 1
                self._pairer.restart()
            self._clock.observe(frame.device_us, frame.arrival_s)
            self._last_s[frame.kind] = frame.arrival_s
            self._frames[frame.kind] += 1
            if frame.kind == "depth":
                self._depths.append(frame)
            pair = self._pairer.add(frame)
            if pair is not None:
                color, depth = pair
                color_s = self._clock.host_s(color.device_us)
                depth_s = None if depth is None else self._clock.host_s(depth.device_us)
                self._pairs.append(RgbdFrame(self.camera, color, depth, color_s, depth_s, self._n_pairs))
                self._n_pairs += 1
            self._fresh.notify_all()

    def _jumped(self, frame: SensorFrame) -> bool:
        before, self._last[frame.kind] = self._last.get(frame.kind), frame
        if before is None:
            return False
        return abs((frame.device_us - before.device_us) * 1e-6 - (frame.arrival_s - before.arrival_s)) > _JUMP_S

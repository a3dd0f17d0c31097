"""Cameras of any make without hardware, for one contract: what they are sent comes out of the make's driver."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from functools import cache
from typing import Any, ClassVar

import numpy as np

from rgbd_calib.sensors.frames import PERIOD_S

LENS = (600.0, 601.0, 320.0, 241.0, 0.1, -0.05, 0.001, 0.0)
"""fx, fy, cx, cy, k1, k2, p1, p2 of every stream."""
T_COLOR_DEPTH = np.array([[0.0, -1, 0, 0.015], [1, 0, 0, 0.001], [0, 0, 1, -0.002], [0, 0, 0, 1]])
"""A quarter turn."""
_BANK = 4


@cache
def _bank(kind: str, width: int, height: int, n: int) -> np.ndarray:
    rng = np.random.default_rng([n, kind == "depth"])
    if kind == "color":
        return rng.integers(0, 256, (height, width, 3), np.uint8)
    return rng.integers(400, 9000, (height, width), np.uint16)


class SoftCamera(ABC):
    """One camera; subclasses give its frames to the double of their SDK."""

    sizes: ClassVar[dict[str, tuple[int, int]]]
    """(width, height) of its streams."""
    unit_m: float
    prefix: str
    """Of its uris."""
    states_geometry: ClassVar[bool] = True
    """It delivers depth as measured, and states lenses and extrinsics; else depth is registered to colour, and no lens stated."""
    may_lack_depth: ClassVar[bool] = True
    """There are cameras of the make without a depth sensor; `depth=False` makes one."""
    synchronises: ClassVar[bool] = True
    """The make has modes of synchronisation by cable."""

    def __init__(self, serial: str, depth: bool = True) -> None:
        self.serial = serial
        self.has_depth = depth
        self.sent = 0
        self.device_us = 1_000_000
        """Of the last frames."""

    def is_at(self, uri: str) -> bool:
        """True for the uri by which its driver opens it."""
        return uri.startswith(self.prefix + self.serial)

    def pixels(self, kind: str, n: int) -> np.ndarray:
        """Of frame n."""
        return _bank(kind, *self.sizes[kind], n % _BANK)

    def send(self, skip: tuple[str, ...] = (), jump_us: int = 0, crop: int = 0) -> None:
        """The next frames: without the streams of `skip`, after a jump of the clock, `crop` rows less than was set up."""
        self.device_us += round(PERIOD_S * 1e6) + jump_us
        frames = {kind: self.pixels(kind, self.sent) for kind in self.sizes if kind not in skip}
        if crop:
            frames = {kind: np.ascontiguousarray(image[:-crop]) for kind, image in frames.items()}
        self.deliver(frames, self.device_us, self.sent)
        self.sent += 1

    @abstractmethod
    def deliver(self, frames: dict[str, np.ndarray], device_us: int, number: int) -> None:
        """Give frames to the double of the SDK."""

    @property
    @abstractmethod
    def automatic(self) -> tuple[bool, bool]:
        """Of exposure and of white balance. A camera begins with both locked, as an earlier session left it."""

    @property
    @abstractmethod
    def sync_place(self) -> int | None:
        """0: it leads, 1: it follows, None: it runs freely."""

    @staticmethod
    @abstractmethod
    def driver(attached: list[Any]) -> Any:
        """The make's driver, with the doubles `attached`."""


class Player:
    """Sends frames of cameras at 30 a second until it is closed."""

    def __init__(self, cameras: list[Any]) -> None:
        self._stop = threading.Event()
        self._cameras = cameras
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        start_s, n = time.monotonic(), 0
        while not self._stop.wait(max(0.0, start_s + n * PERIOD_S - time.monotonic())):
            n += 1
            for camera in list(self._cameras):
                camera.send()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()

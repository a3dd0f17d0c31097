"""Colour and depth of the same exposure, by the time stamps of their common device clock."""

from __future__ import annotations

from collections import deque

from rgbd_calib.sensors.frames import PERIOD_S, Kind, SensorFrame

_MAX_WAITING = 8


class _Gaps:
    """Frames that never came, by gaps between the stamps of a stream."""

    def __init__(self, period_s: float) -> None:
        self._period_us = period_s * 1e6
        self._last_us: dict[Kind, int] = {}

    def before(self, frame: SensorFrame) -> int:
        """How many are missing before this one."""
        last_us, self._last_us[frame.kind] = self._last_us.get(frame.kind), frame.device_us
        return 0 if last_us is None else max(0, round((frame.device_us - last_us) / self._period_us) - 1)

    def restart(self) -> None:
        self._last_us.clear()


class ColorAlone:
    """In place of the pairer, for devices without depth: each frame is complete."""

    def __init__(self, period_s: float = PERIOD_S) -> None:
        self._gaps = _Gaps(period_s)
        self.lost: dict[Kind, int] = {"color": 0}
        self.unpaired: dict[Kind, int] = {"color": 0}

    def add(self, frame: SensorFrame) -> tuple[SensorFrame, None]:
        self.lost[frame.kind] += self._gaps.before(frame)
        return frame, None

    def restart(self) -> None:
        self._gaps.restart()


class ColorDepthPairer:
    """Pairs the two streams of one device: the nearest stamp within half a period, each frame used once."""

    def __init__(self, period_s: float = PERIOD_S) -> None:
        self._period_us = period_s * 1e6
        self._waiting: dict[Kind, deque[SensorFrame]] = {"color": deque(), "depth": deque()}
        self._gaps = _Gaps(period_s)
        self.lost: dict[Kind, int] = {"color": 0, "depth": 0}
        """Frames that never came, by gaps between the stamps."""
        self.unpaired: dict[Kind, int] = {"color": 0, "depth": 0}
        """Frames that came without a partner."""

    def add(self, frame: SensorFrame) -> tuple[SensorFrame, SensorFrame] | None:
        """The (colour, depth) pair that `frame` completes, if it does."""
        self.lost[frame.kind] += self._gaps.before(frame)
        other: Kind = "depth" if frame.kind == "color" else "color"
        partners = self._waiting[other]
        near = min(partners, key=lambda f: abs(f.device_us - frame.device_us), default=None)
        if near is None or abs(near.device_us - frame.device_us) > self._period_us / 2:
            self._wait(frame)
            return None
        while partners[0] is not near:
            partners.popleft()
            self.unpaired[other] += 1
        partners.popleft()
        self.unpaired[frame.kind] += len(self._waiting[frame.kind])
        self._waiting[frame.kind].clear()
        return (frame, near) if frame.kind == "color" else (near, frame)

    def restart(self) -> None:
        """The device's clock was set anew: what waits has no partner, and no gap is counted."""
        for kind, waiting in self._waiting.items():
            self.unpaired[kind] += len(waiting)
            waiting.clear()
        self._gaps.restart()

    def _wait(self, frame: SensorFrame) -> None:
        waiting = self._waiting[frame.kind]
        waiting.append(frame)
        if len(waiting) > _MAX_WAITING:
            waiting.popleft()
            self.unpaired[frame.kind] += 1

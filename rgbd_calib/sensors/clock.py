"""From a device's clock to the host's.

A frame arrives after its exposure by a delay that is never below some minimum: arrival = device + offset + delay.
So the offset is the lower envelope of (arrival - device time). It is taken over the last seconds only, since the
clocks of two devices drift apart by up to about 100 ppm (1 ms in 10 s).
"""

from __future__ import annotations

from collections import deque

WINDOW_S = 10.0
_BUCKET_S = 0.5


class DeviceClock:
    """Maps the time stamps of one device to the host's monotonic clock."""

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self._buckets: deque[tuple[int, float]] = deque()
        self._window = int(window_s / _BUCKET_S)

    def observe(self, device_us: int, arrival_s: float) -> None:
        """Learn from a frame with time stamp `device_us` that was read at `arrival_s`."""
        bucket, offset_s = int(arrival_s / _BUCKET_S), arrival_s - device_us * 1e-6
        if self._buckets and self._buckets[-1][0] == bucket:
            self._buckets[-1] = (bucket, min(self._buckets[-1][1], offset_s))
        else:
            self._buckets.append((bucket, offset_s))
        while self._buckets[0][0] < bucket - self._window:
            self._buckets.popleft()

    def host_s(self, device_us: int) -> float:
        """Time of a device's stamp on the host's clock, seconds; later than the truth by the shortest delay."""
        return device_us * 1e-6 + min(offset_s for _, offset_s in self._buckets)

"""Cameras that run free: when each exposes, and what its stamps say of that.

t = stamp + offset + 1e-6 drift (stamp - first stamp) is the instant at which the middle row of a colour image is exposed; row v
of h is exposed readout ((v + 0.5) / h - 0.5) later. The depth of the same frame is of the instant t + depth_delay, and has the
colour image's stamp.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.types import Clock


@dataclass(frozen=True)
class WaveParams:
    """A recording of a carried board by free-running cameras."""

    seconds: float = 30.0
    rate_hz: float = 30.0
    offset_s: float = 5.0
    """Offsets of the clocks are drawn from +- this; 0: one clock."""
    drift_ppm: float = 20.0
    """Deviation of the drifts."""
    jitter_s: float = 0.0
    """Deviation of the stamps, as of a host's."""
    lost: float = 0.02
    """Share of dropped frames."""
    depth_delay_s: float = 0.008
    """Delays of depth against colour are drawn from +- this."""
    readout_s: float = 0.0
    """Of a rolling shutter, from the first row to the last."""
    exposure_s: float = 0.006
    """Motion blurs over it."""
    phases: bool = True
    """False: all cameras expose at the same instants."""


@dataclass(frozen=True)
class CameraClock:
    """One camera's timing: what was drawn."""

    first_s: float
    """True time of its first exposure."""
    period_s: float
    offset_s: float
    drift_ppm: float
    depth_delay_s: float
    readout_s: float
    jitter_s: float

    @property
    def truth(self) -> Clock:
        """As a rig file has it."""
        return Clock(self.offset_s, self.drift_ppm, self.depth_delay_s, self.readout_s, self.jitter_s)


@dataclass(frozen=True)
class Exposures:
    """The frames of one camera that were not dropped."""

    stems: tuple[str, ...]
    t_s: FloatArray
    """(n,), true, of the middle row."""
    stamps_us: FloatArray
    """(n,)."""


def draw_clocks(cameras: Sequence[str], params: WaveParams, rng: np.random.Generator) -> dict[str, CameraClock]:
    """Of each camera; the first one's clock is the reference, zero but for its delay."""
    out, period = {}, 1 / params.rate_hz
    for i, name in enumerate(cameras):
        phase = rng.uniform(0, period) if params.phases else 0.0
        offset, drift = rng.uniform(-params.offset_s, params.offset_s), rng.normal(0, params.drift_ppm)
        delay = rng.uniform(-params.depth_delay_s, params.depth_delay_s)
        offset, drift = (offset, drift) if i else (0.0, 0.0)
        out[name] = CameraClock(phase, period, offset, drift, delay, params.readout_s, params.jitter_s)
    return out


def expose(clock: CameraClock, params: WaveParams, rng: np.random.Generator) -> Exposures:
    """All frames of one camera in the recording's time."""
    t = clock.first_s + clock.period_s * np.arange(int((params.seconds - clock.first_s) / clock.period_s))
    stamps = t[0] - clock.offset_s + (t - t[0]) / (1 + 1e-6 * clock.drift_ppm)
    stamps = stamps + params.jitter_s * rng.standard_normal(len(t))
    kept = rng.random(len(t)) >= params.lost
    kept[0] = True  # the drift counts from the first stamp
    numbers = np.flatnonzero(kept)
    stamps_us = np.asarray(np.round(1e6 * stamps[kept], 1), float)
    return Exposures(tuple(f"{k:06d}" for k in numbers), np.asarray(t[kept], float), stamps_us)

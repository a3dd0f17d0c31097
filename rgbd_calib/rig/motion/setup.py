"""What an estimate of a carried board starts from beyond the bundle's setup: stamps, and what is known of the clocks."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rgbd_calib.geometry.linear import IntArray
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.setup import Setup
from rgbd_calib.types import Clock

DRIFT_SD_PPM = 50.0
"""Prior of the drift of one quartz against another: they are made to 20 or 30 ppm."""
OFFSET_SD_S = 0.050
"""Prior of an offset about where the correlation of the motions puts it, which is good to some ms."""
DELAY_SD_S = 0.010
"""Prior of the depth's delay against its colour image: half a period of 30 Hz is the most that is usual."""
DRIFT_OF_DEPTH_SD_PPM = 0.1
"""Prior of the drift of a depth camera's stamps against those of its colour camera: one quartz."""
READOUT_SD_S = 0.015
"""Prior of the readout time where the shutter is not known: rolling shutters of 30 Hz take up to 30 ms."""


@dataclass(frozen=True)
class ClockPrior:
    """Of one camera, about a start."""

    start: Clock = field(default_factory=Clock)
    offset_sd_s: float = OFFSET_SD_S
    drift_sd_ppm: float = DRIFT_SD_PPM
    delay_sd_s: float = DELAY_SD_S
    readout_sd_s: float = READOUT_SD_S
    """0: a global shutter."""
    beside: str = ""
    """Of a depth camera: the colour camera whose clock it has, but for a delay."""


@dataclass(frozen=True)
class MotionSetup(Setup):
    """The first frames are carried, one view each; the others stand."""

    color_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(carried,), stamps of the colour images, s."""
    depth_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(carried,), of the depth images."""
    camera_of: IntArray = field(default_factory=lambda: np.zeros(0, int))
    """(carried,) camera of each."""
    first_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(C,), the first stamp of each camera, from which its drift counts."""
    clocks: tuple[ClockPrior, ...] = ()
    n_windows: int = 0
    step_s: float = 0.05
    """Between the knots of the spline."""

    @property
    def n_carried(self) -> int:
        return len(self.color_s)

    def times_s(self, clock: FloatArray, delay: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Instants (carried,) of colour and depth by the clocks (C, 2) and delays (C, 1)."""
        own = self.camera_of
        first, (offset, drift) = self.first_s[own], clock[own].T
        color, depth = (s + offset + 1e-6 * drift * (s - first) for s in (self.color_s, self.depth_s))
        return color, depth + delay[own, 0]

"""What sensors deliver: single frames, colour and depth of one exposure, and one instant over all cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Kind = Literal["color", "depth"]

PERIOD_S = 1 / 30
"""Between two exposures of an Xtion's VGA modes."""


@dataclass(frozen=True)
class SensorFrame:
    """One frame of one stream, copied out of the runtime."""

    kind: Kind
    pixels: np.ndarray
    """Colour (h, w, 3) uint8, R G B; depth (h, w) uint16, raw units, 0 = none."""
    device_us: int
    """The device's own clock: starts at its first frame, common to its two streams."""
    index: int
    """The device's frame number; counts good frames only, so it does not show losses."""
    arrival_s: float
    """time.monotonic() when the frame was read."""
    infrared: np.ndarray | None = None
    """(h, w): the infrared image of the same exposure and geometry as a depth frame; None where the device gives none."""


@dataclass(frozen=True)
class RgbdFrame:
    """Colour and depth of one exposure of one camera, or colour alone."""

    camera: str
    color: SensorFrame
    depth: SensorFrame | None
    """None of a camera that gives colour alone."""
    color_s: float
    """Time of the colour exposure on the host's monotonic clock."""
    depth_s: float | None
    number: int = 0
    """Of the pairs that its reader made."""


@dataclass(frozen=True)
class FrameSet:
    """One instant: a frame of each camera that delivered, and how far their exposures lie apart."""

    frames: dict[str, RgbdFrame]
    spread_s: float
    absent: tuple[str, ...] = ()
    """Cameras of the rig that delivered nothing for this instant."""

    @property
    def time_s(self) -> float:
        """Time of the earliest colour exposure, host's monotonic clock."""
        return min(frame.color_s for frame in self.frames.values())

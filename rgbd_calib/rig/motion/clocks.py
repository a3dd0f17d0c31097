"""The unknowns of time: clocks, the delay of depth against colour, and the readout of a rolling shutter.

A stamp s of camera l is of the instant t = s + offset_l + 1e-6 drift_l (s - s_l), s_l its first; of the middle row of its
colour image, half an exposure after it begins; of depth, t + delay_l. Row v of h rows is exposed readout_l ((v + 1/2) / h - 1/2)
later. The exposure's midpoint, if the stamp is of its beginning, is part of the offset. A depth camera with a geometry of its
own is a camera of its own, whose offset is known beside that of its colour camera: the difference is the delay.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Block, BlockPrior, Fault, Kind, Scope
from rgbd_calib.rig.motion.setup import DRIFT_OF_DEPTH_SD_PPM, MotionSetup
from rgbd_calib.rig.motion.sight import DelayedLook, MovingSight, by_time
from rgbd_calib.rig.sight import Look


class OfTime(Block):
    """A block with a Gaussian prior for each parameter; a deviation of zero holds it."""

    scope = Scope.CAMERA
    setup: MotionSetup

    @abstractmethod
    def means_and_sds(self) -> tuple[FloatArray, FloatArray]:
        """Means and deviations, (C, n) each."""

    def start(self) -> FloatArray:
        return self.means_and_sds()[0]

    def prior(self) -> BlockPrior:
        mean, sd = (x.ravel() for x in self.means_and_sds())
        free = sd > 0
        information = np.diag(np.where(free, 1 / np.where(free, sd, 1.0) ** 2, 0.0))
        return BlockPrior(mean, information, free, free)


class ClockBlock(OfTime):
    """Offset (s) and drift (ppm) of each camera; the reference's are zero."""

    name = "clock"
    kinds = frozenset({Kind.PIXEL, Kind.DEPTH})
    over_time = Fault(
        "clock over time",
        lambda t: (
            f"{t.camera}'s timestamps jumped by {-1e3 * t.estimate[0]:+.1f} ms against the other cameras' at frame {t.frame}: the "
            f"boards are {t.mm} off"
        ),
        "The clock was set, frames were dropped without notice, or the timestamps are the host's. Record device timestamps, or cut "
        "the recording there",
        parameters=1,
    )

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("clock offset", "clock drift")

    def means_and_sds(self) -> tuple[FloatArray, FloatArray]:
        own = self.setup
        mean = np.array([[c.start.offset_s, c.start.drift_ppm] for c in own.clocks])
        sd = np.array([[c.offset_sd_s, c.drift_sd_ppm] for c in own.clocks])
        sd[own.cameras.index(own.reference)] = 0.0
        return mean, sd

    def prior(self) -> BlockPrior:
        """Of a depth camera what is known is the difference to its colour camera."""
        plain, own = super().prior(), self.setup
        information = plain.information.copy()
        for c, clock in enumerate(own.clocks):
            if clock.beside:
                at, color = self.columns(c), self.columns(own.cameras.index(clock.beside))
                tie = np.array([clock.delay_sd_s, DRIFT_OF_DEPTH_SD_PPM]) ** -2.0
                information[at, at] = tie
                information[color, color] += tie
                information[at, color] = information[color, at] = -tie
        return replace(plain, information=information)

    def derivative(self, look: Look) -> FloatArray:
        rate = by_time(look)
        age = look.sight.age_s if isinstance(look.sight, MovingSight) else np.zeros(len(rate))
        return np.stack([rate, 1e-6 * age[:, None, None] * rate], axis=-1)


class DepthDelay(OfTime):
    """By how much depth is later than its colour image beyond what the stamps say, s."""

    name = "depth delay"
    kinds = frozenset({Kind.DEPTH})
    over_time = Fault(
        "depth delay over time",
        lambda t: (
            f"{t.camera}'s depth images are {1e3 * t.estimate[0]:+.1f} ms later against its colour images from frame {t.frame} on "
            "than before"
        ),
        "Colour and depth frames were paired differently: record both with their own timestamps",
        parameters=1,
    )

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("delay of depth",)

    def means_and_sds(self) -> tuple[FloatArray, FloatArray]:
        mean = np.array([[c.start.depth_delay_s] for c in self.setup.clocks])
        return mean, np.array([[0.0 if c.beside else c.delay_sd_s] for c in self.setup.clocks])

    def changes(self, look: Look) -> bool:
        return super().changes(look) and not self.setup.clocks[look.camera].beside

    def derivative(self, look: Look) -> FloatArray:
        return by_time(look, of_depth_alone=True)[..., None]


class Readout(OfTime):
    """Time from the first row of a colour image to the last, s; negative where it goes upwards."""

    name = "readout"
    kinds = frozenset({Kind.PIXEL, Kind.DEPTH})

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("readout time",)

    def means_and_sds(self) -> tuple[FloatArray, FloatArray]:
        mean = np.array([[c.start.readout_s] for c in self.setup.clocks])
        return mean, np.array([[0.0 if c.beside else c.readout_sd_s] for c in self.setup.clocks])

    def derivative(self, look: Look) -> FloatArray:
        if isinstance(look, DelayedLook):  # it is read where the corner was seen
            rate = np.einsum("nird,nid->nir", look.by_seen, look.seen.velocity)
            return (rate * look.seen.row[..., None])[..., None]
        row = look.sight.row if isinstance(look.sight, MovingSight) else np.zeros(look.left.shape[:2])
        return (by_time(look) * row[..., None])[..., None]


OF_TIME: tuple[type[OfTime], ...] = (ClockBlock, DepthDelay, Readout)

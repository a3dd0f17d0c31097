"""Parameters of a simulation, and its random generators."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rgbd_calib.geometry.camera import LensKind
from rgbd_calib.simulation.clocks import WaveParams
from rgbd_calib.simulation.color_sensor import ColorNoise
from rgbd_calib.simulation.depth_sensor import DepthNoise
from rgbd_calib.simulation.realism import IDEAL, Realism
from rgbd_calib.simulation.rig import Layout, Sensor
from rgbd_calib.simulation.time_of_flight import TimeOfFlight
from rgbd_calib.types import Board

RIG, SHARED, CLOSE, ROOM, IMAGE, WALL, PRINT, SENSORS, TAPE, LIGHT, LENSES, SNAPSHOT, WAVE = range(13)
"""First element of the key of each random generator."""


@dataclass(frozen=True)
class SimulationParams:
    """What to simulate. `frames` None: 30, or 8 per camera if that is more."""

    cameras: int = 4
    layout: Layout = "arc"
    frames: int | None = None
    intrinsic_views: int = 20
    distances_m: tuple[float, ...] = (0.6, 0.9, 1.2, 1.5, 1.8, 2.2, 2.6, 3.0, 3.5, 4.0)
    width: int = 640
    height: int = 480
    seed: int = 0
    board: Board = field(default=Board(9, 6, 0.060, two_sided=True, thickness_m=0.006))
    color_noise: ColorNoise = field(default=ColorNoise())
    sensor: Sensor = "structured-light"
    depth_noise: DepthNoise | TimeOfFlight = field(default=DepthNoise())
    depth_readings: int = 1
    """Readings of the sensor that each depth image is the mean of, as `capture` takes them of a board held still."""
    bias: bool = True
    """False: no depth bias."""
    jpeg_quality: int | None = None
    """None: PNG."""
    lenses: tuple[LensKind, ...] = ("brown",)
    """Lens models of the colour cameras, in turn."""
    depth_size: tuple[int, int] | None = None
    """Width and height of unregistered depth images, px; None: depth is registered to colour."""
    infrared: bool = False
    """Also save infrared images of the depth cameras."""
    realism: Realism = IDEAL
    """Errors in addition to lens distortion, depth bias and noise."""
    wave: WaveParams | None = None
    """The board is carried before free-running cameras, in place of the shared frames; None: it stands still."""


def generator(seed: int, *key: int) -> np.random.Generator:
    """The random generator of one part of the simulation."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))

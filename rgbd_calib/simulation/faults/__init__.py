"""Ways to spoil a session: each a function from a scene to what is found on disk."""

from rgbd_calib.simulation.faults import (  # each adds its own
    board,
    cameras,
    depth,
    filming,
    mechanics,
    reported,
    sensors,
    told,
)
from rgbd_calib.simulation.faults.common import FAULTS, RINGS, Fault

__all__ = [
    "FAULTS",
    "RINGS",
    "Fault",
    "board",
    "cameras",
    "depth",
    "filming",
    "mechanics",
    "reported",
    "sensors",
    "told",
]

"""Ways to spoil a session: each a function from a scene to what is found on disk."""

from rgbd_calib.synthetic.faults import board, cameras, depth, filming  # each adds its own
from rgbd_calib.synthetic.faults.common import FAULTS, RINGS, Fault

__all__ = ["FAULTS", "RINGS", "Fault", "board", "cameras", "depth", "filming"]

"""Where cameras stand by a few frames, against where a rig says: for verifying a rig and for doubting a recording."""

from rgbd_calib.trust.displacement.cameras import CameraPoses, board_poses, joined_to, locate_cameras
from rgbd_calib.trust.displacement.verdict import Moved, PairError, Verdict, VerdictParams, judge
from rgbd_calib.trust.displacement.view_fit import FittedView, Noise, fit_view

__all__ = [
    "CameraPoses",
    "FittedView",
    "Moved",
    "Noise",
    "PairError",
    "Verdict",
    "VerdictParams",
    "board_poses",
    "fit_view",
    "joined_to",
    "judge",
    "locate_cameras",
]

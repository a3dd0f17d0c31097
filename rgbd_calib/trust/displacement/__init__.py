"""Where cameras stand by a few frames, against where a rig says: for verifying a rig and for doubting a recording."""

from rgbd_calib.trust.displacement.cameras import LocatedCameras, board_poses, joined_to, locate_cameras
from rgbd_calib.trust.displacement.verdict import DisplacementVerdict, Moved, PairError, VerdictParams, judge
from rgbd_calib.trust.displacement.view_fit import FittedView, ObservationNoise, fit_view

__all__ = [
    "DisplacementVerdict",
    "FittedView",
    "LocatedCameras",
    "Moved",
    "ObservationNoise",
    "PairError",
    "VerdictParams",
    "board_poses",
    "fit_view",
    "joined_to",
    "judge",
    "locate_cameras",
]

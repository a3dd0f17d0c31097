"""Where cameras stand by a snapshot of their scene, each against its own old one, without a board."""

from rgbd_calib.trust.snapshot.camera import Before, CameraMotion, camera_motion
from rgbd_calib.trust.snapshot.determined import drift_sentence
from rgbd_calib.trust.snapshot.rig import CameraVerdict, RigVerdict, SnapshotParams, judge_motions

__all__ = [
    "Before",
    "CameraMotion",
    "CameraVerdict",
    "RigVerdict",
    "SnapshotParams",
    "camera_motion",
    "drift_sentence",
    "judge_motions",
]

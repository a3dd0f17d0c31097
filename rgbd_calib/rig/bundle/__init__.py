"""The joint bundle of all cameras, boards, intrinsics and depth biases, on pixels and depth together.

The pixels alone leave the focal lengths a little free, and with them the distances: that error dominates a real rig.
Measured depth pins them. :mod:`.model` has the unknowns and residuals, :mod:`.start` where they begin and what is known
before, :mod:`.solve` the minimiser and the covariance, :mod:`.variance` the weights, :mod:`.gross` what is dropped,
:mod:`.observability` what the recording cannot tell, :mod:`.common_errors` what all views share, :mod:`.estimate` the rounds of all this.
"""

from rgbd_calib.rig.bundle.estimate import bundle, free_structure
from rgbd_calib.rig.bundle.params import BundleParams, CameraPrior, Round
from rgbd_calib.rig.bundle.result import BundleResult, board_poses, camera_statistics, pose_covariance

__all__ = [
    "BundleParams",
    "BundleResult",
    "CameraPrior",
    "Round",
    "board_poses",
    "bundle",
    "camera_statistics",
    "free_structure",
    "pose_covariance",
]

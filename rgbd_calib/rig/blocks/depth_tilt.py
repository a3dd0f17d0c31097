"""The axis that depth is measured along is turned against the colour camera's.

    z_true = z + ... + z (t_x x + t_y y)        (x, y, 1) the ray of the pixel

The depth of a pixel is along the depth camera's axis, and keeps that value where a driver moves the pixel to where colour sees
it. A depth camera that is turned by what moves its image by one pixel tilts a wall 3 m away by 2 mm to the image's border.
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import BlockPrior
from rgbd_calib.rig.blocks.depth_error import LinearDepthErrorBlock


class DepthTilt(LinearDepthErrorBlock):
    """t_x, t_y (rad) of each camera."""

    name = "depth tilt"

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("tilt of the depth's axis in x", "tilt of the depth's axis in y")

    def prior(self) -> BlockPrior:
        setup, n = self.setup, self.size
        free = np.zeros((self.sets, self.n), bool)
        for c, prior in enumerate(setup.priors):
            seen = bool(np.any(setup.obs.has_depth[setup.obs.camera == c]))
            free[c] = seen and prior.held == "nothing" and not prior.same_sensor
        information = np.eye(n) / setup.params.depth_tilt_sd_rad**2
        return BlockPrior(np.zeros(n), information, free.ravel(), np.zeros(n, bool))

    def basis(self, camera: int, pixels_px: FloatArray, depth_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        rays = np.nan_to_num(self.setup.priors[camera].intrinsics.rays(pixels_px)[..., :2])
        return rays * depth_m[..., None], rays

"""What depth errs by on the board and on nothing else: black squares are dark, and time of flight errs by millimetres on them.

    z_true = z + ... + c0 + c1 z        of the depth on boards, not of walls

Light that strays in the lens, or comes by another surface, adds to a dark surface's own a phase that is another's (M. Lindner,
A. Kolb, Calibration of the intensity-related distance error of the PMD TOF-camera, SPIE 6764, 2007; H. Sarbolandi et al., CVIU
139, 2015). It is no part of the depth's bias, which is for other surfaces too. Without walls nothing tells the two apart.
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.linear import BoolArray
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import BlockPrior, Kind
from rgbd_calib.rig.blocks.depth_error import LinearDepthErrorBlock
from rgbd_calib.rig.setup import Setup


class DepthOfBoard(LinearDepthErrorBlock):
    """c0 (m) and c1 of each camera."""

    name = "depth of board"
    kinds = frozenset({Kind.DEPTH})
    sd = np.array([0.002, 0.0005])
    """Prior: metres, and metres per metre."""

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        return any(prior.time_of_flight for prior in setup.priors)

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("offset of the depth on boards", "its growth with the distance")

    def views(self) -> BoolArray:
        """(V,) bool, those that it corrects."""
        return np.ones(len(self.setup.obs.camera), bool)

    def prior(self) -> BlockPrior:
        obs, free = self.setup.obs, np.zeros((self.sets, self.n), bool)
        for c, prior in enumerate(self.setup.priors):
            seen = bool(np.any(obs.has_depth[self.views() & (obs.camera == c)]))
            free[c] = seen and prior.held == "nothing" and prior.time_of_flight
        information = np.diag(np.tile(self.sd**-2.0, self.sets))
        return BlockPrior(np.zeros(self.size), information, free.ravel(), np.zeros(self.size, bool))

    def basis(self, camera: int, pixels_px: FloatArray, depth_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        one = np.ones(depth_m.shape)
        return np.stack([one, depth_m], axis=-1), np.stack([0.0 * one, one], axis=-1)

"""What depth was off by while a camera's own recording was made, against the rig's: sensors warm up.

    z_true = z + ... + d0 + d1 z        of the depth in views of an intrinsic recording

Time of flight drifts by up to 5 to 20 mm over the first half hour, uniformly over the image (E. Lachat et al., Assessment
and calibration of a RGB-D camera (Kinect v2 sensor), Remote Sensing 7(10), 2015; P. Fuersattel et al., A comparative error
analysis of current time-of-flight sensors, IEEE TCI 2(1), 2016); as it goes on while boards are filmed from near to far, it goes
with the distance too. Triangulating sensors drift by less, and are tested for it.
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.linear import BoolArray
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Block, BlockPrior, Fault, Kind, Scope
from rgbd_calib.rig.setup import Setup
from rgbd_calib.rig.sight import Look

SD = np.array([0.005, 0.001])
"""Metres, and metres per metre."""


class DepthDrift(Block):
    """d0 (m) and d1 of each camera."""

    name = "depth drift"
    scope = Scope.CAMERA
    kinds = frozenset({Kind.DEPTH})
    known = Fault(
        "depth between recordings",
        lambda t: (
            f"{t.camera}'s depth in the rig's recording differs from that of its intrinsic recording, by {t.mm}, more than "
            "sensors drift"
        ),
        "Check that both are of the same camera, mode and depth scale; let the sensor warm up before either",
    )

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        return any(prior.time_of_flight for prior in setup.priors) and bool(setup.obs.alone.any())

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("drift of the depth since the intrinsic recording", "its growth with the distance")

    def prior(self) -> BlockPrior:
        obs, free = self.setup.obs, np.zeros((self.sets, self.n), bool)
        for c, prior in enumerate(self.setup.priors):
            seen = bool(np.any(obs.has_depth[obs.alone & (obs.camera == c)]))
            free[c] = seen and prior.held == "nothing" and prior.time_of_flight
        information = np.diag(np.tile(SD**-2.0, self.sets))
        return BlockPrior(np.zeros(self.size), information, free.ravel(), np.zeros(self.size, bool))

    def derivative(self, look: Look) -> FloatArray:
        assert look.slope is not None  # rows of depth have it
        by_error = np.where(look.sight.obs.alone[:, None], -1 / look.slope, 0.0)
        return np.stack([by_error, by_error * (look.depth_m + look.left[..., 0])], axis=-1)[..., None, :]


def drift_m(own: FloatArray, alone: BoolArray, depth_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """True less reported depth (n, N), metres, and its slope, by the parameters (2,) of a camera; of views, `alone` (n,) or not."""
    by_view = np.where(alone[:, None], own, 0.0)
    return by_view[:, :1] + by_view[:, 1:] * depth_m, np.broadcast_to(by_view[:, 1:], depth_m.shape)

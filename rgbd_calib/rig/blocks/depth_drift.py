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
from rgbd_calib.rig.blocks.block import Fault
from rgbd_calib.rig.blocks.depth_of_board import DepthOfBoard
from rgbd_calib.rig.setup import Setup


class DepthDrift(DepthOfBoard):
    """d0 (m) and d1 of each camera."""

    name = "depth drift"
    sd = np.array([0.005, 0.001])
    of_alone = True
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
        return super().applies(setup) and bool(setup.obs.alone.any())

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("drift of the depth since the intrinsic recording", "its growth with the distance")

    def views(self) -> BoolArray:
        return self.setup.obs.alone

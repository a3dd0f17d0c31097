"""Where the cameras stand: a left perturbation (rad, m) of T_world_color; the reference's is held.

T_world_color <- Exp(xi) T_world_color moves a point of the world, as the camera sees it, by R_color_world (p_w x phi - rho).
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Block, BlockPrior, Fault, Kind, Scope
from rgbd_calib.rig.sight import Look


class CameraPoses(Block):
    """T_world_color (C, 4, 4)."""

    name = "pose"
    scope = Scope.CAMERA
    kinds = frozenset({Kind.PIXEL, Kind.DEPTH})
    over_time = Fault(
        "pose over time",
        lambda t: f"{t.camera} moved at frame {t.frame}: the boards are {t.mm} off",
        "Something moved it, or the frames are of two sessions. Keep the frames of one side only, or fix the camera and "
        "record again",
        shared=True,
    )

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("turn about x", "turn about y", "turn about z", "shift in x", "shift in y", "shift in z")

    def start(self) -> FloatArray:
        return self.setup.T_world_color

    def prior(self) -> BlockPrior:
        own = self.setup
        free = [
            name != own.reference and prior.held != "all" for name, prior in zip(own.cameras, own.priors, strict=True)
        ]
        nothing = np.zeros(self.size)
        return BlockPrior(nothing, np.zeros((self.size,) * 2), np.repeat(free, 6), np.zeros(self.size, bool))

    def moved(self, value: FloatArray, step: FloatArray) -> FloatArray:
        return se3.retract(value, step.reshape(-1, 6))

    def vector(self, value: FloatArray) -> FloatArray:
        return np.zeros(self.size)

    def derivative(self, look: Look) -> FloatArray:
        return np.where(look.sight.obs.shared[:, None, None, None], -look.by_motion, 0.0)

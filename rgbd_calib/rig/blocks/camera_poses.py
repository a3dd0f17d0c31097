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
        return BlockPrior(np.zeros(self.size), self._mounts(), np.repeat(free, 6), np.zeros(self.size, bool))

    def _mounts(self) -> FloatArray:
        """(6 C, 6 C), what is known of depth cameras beside their colour cameras.

        With a and b the perturbations of the poses of colour and depth, that of T_color_depth is Ad(T_color_world)(b - a).
        """
        out = np.zeros((self.size,) * 2)
        for depth, prior in enumerate(self.setup.priors):
            if prior.mount is not None:
                color = self.setup.cameras.index(prior.mount.camera)
                J = np.zeros((6, self.size))
                J[:, 6 * depth : 6 * depth + 6] = se3.adjoint(se3.inverse(self.setup.T_world_color[color]))
                J[:, 6 * color : 6 * color + 6] = -J[:, 6 * depth : 6 * depth + 6]
                out += J.T @ np.diag(prior.mount.sd**-2.0) @ J
        return out

    def moved(self, value: FloatArray, step: FloatArray) -> FloatArray:
        return se3.retract(value, step.reshape(-1, 6))

    def vector(self, value: FloatArray) -> FloatArray:
        """From where the estimate began."""
        return se3.difference(value, self.setup.T_world_color).ravel()

    def derivative(self, look: Look) -> FloatArray:
        return np.where(look.sight.obs.shared[:, None, None, None], -look.by_motion, 0.0)

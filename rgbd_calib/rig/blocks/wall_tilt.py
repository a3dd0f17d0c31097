"""How far all walls of a camera are from square to it alike: it stood askew, or moved along a rail that does."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Block, BlockPrior, Component, Kind, Scope
from rgbd_calib.rig.sight import Look

DOF = 1e-4
"""Of what is usual: walls stand askew by a degree, or as square as a set square has them."""


class WallTilt(Block):
    """Added to the tilts a, b of the planes z = D / (1 - a x - b y) of each camera's walls."""

    name = "wall tilt"
    scope = Scope.CAMERA
    kinds = frozenset({Kind.WALL})

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("tilt of the walls in x", "tilt of the walls in y")

    def prior(self) -> BlockPrior:
        own, n, components = self.setup, self.n, []
        for c, camera in enumerate(own.cameras):
            at = c * n + np.arange(n)
            components.append(Component(f"{camera}: wall tilt", at, np.eye(n), own.params.wall_tilt_sd_rad, DOF))
        seen = np.repeat(np.isin(np.arange(self.sets), own.walls.camera), n)
        nothing = np.zeros((self.size,) * 2)
        return BlockPrior(np.zeros(self.size), nothing, seen, np.zeros(self.size, bool), tuple(components))

    def derivative(self, look: Look) -> FloatArray:
        assert look.by_tilts is not None  # rows of walls have it
        return look.by_tilts[:, :, None]

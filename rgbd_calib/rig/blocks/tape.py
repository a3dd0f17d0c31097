"""What all written distances of a camera's walls are off by: one tape, one zero."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Block, BlockPrior, Kind, Scope
from rgbd_calib.rig.sight import Look


class Tape(Block):
    """Metres, added to the written distances."""

    name = "tape"
    scope = Scope.CAMERA
    kinds = frozenset({Kind.WALL})

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("zero of the tape",)

    def prior(self) -> BlockPrior:
        n = self.size
        seen = np.isin(np.arange(n), self.setup.walls.camera)
        information = np.eye(n) / self.setup.params.tape_sd_m**2
        return BlockPrior(np.zeros(n), information, seen, np.zeros(n, bool))

    def derivative(self, look: Look) -> FloatArray:
        assert look.by_distance is not None  # rows of walls have it
        return look.by_distance[..., None, None]

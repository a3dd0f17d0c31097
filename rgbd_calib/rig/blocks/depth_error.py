"""What the blocks of the depth's error share: z_true = z + sum of basis functions of the pixel and of the reported depth."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Block, Kind, Scope
from rgbd_calib.rig.sight import Look


class DepthErrorBlock(Block):
    """Coefficients (C, n) of a correction of the reported depth."""

    scope = Scope.CAMERA
    kinds = frozenset({Kind.DEPTH, Kind.WALL})

    @abstractmethod
    def basis(self, camera: int, pixels_px: FloatArray, depth_m: FloatArray) -> FloatArray:
        """(..., n) at pixels (..., 2) of the depth image and reported depths (...), metres."""

    @abstractmethod
    def basis_slope(self, camera: int, pixels_px: FloatArray, depth_m: FloatArray) -> FloatArray:
        """(..., n), its derivative by the reported depth."""

    def derivative(self, look: Look) -> FloatArray:
        assert look.slope is not None  # rows of depth have it
        at = look.camera, look.pixels_px, look.depth_m
        by_noise = look.left * self.basis_slope(*at)
        return np.asarray(-((self.basis(*at) + by_noise) / look.slope[..., None])[..., None, :])

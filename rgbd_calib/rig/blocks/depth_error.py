"""What the blocks of the depth's error share: z_true = z + a function of the pixel and of the reported depth."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Block, Kind, Scope
from rgbd_calib.rig.sight import Look


class DepthErrorBlock(Block):
    """Parameters (C, n) of a correction of the reported depth."""

    scope = Scope.CAMERA
    kinds = frozenset({Kind.DEPTH, Kind.WALL})

    @abstractmethod
    def error(
        self, camera: int, own: FloatArray, pixels_px: FloatArray, depth_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """True less reported depth (...), metres, by the camera's parameters (n,), and its slope (...), at pixels (..., 2) of
        the depth image and reported depths (...), metres."""

    @abstractmethod
    def by_parameters(
        self, camera: int, own: FloatArray, pixels_px: FloatArray, depth_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Derivatives (..., n) of the error, and of its slope, by the parameters (n,)."""

    def derivative(self, look: Look) -> FloatArray:
        assert look.slope is not None  # rows of depth have it
        own = look.values.get(self.name, np.zeros(self.n))
        by_own, slope_by_own = self.by_parameters(look.camera, own, look.pixels_px, look.depth_m)
        return np.asarray(-((by_own + look.left * slope_by_own) / look.slope[..., None])[..., None, :])


class LinearDepthErrorBlock(DepthErrorBlock):
    """A correction that is linear in its parameters."""

    @abstractmethod
    def basis(self, camera: int, pixels_px: FloatArray, depth_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Functions (..., n) at pixels (..., 2) of the depth image and reported depths (...), metres, and their slopes
        (..., n) by the reported depth."""

    def error(
        self, camera: int, own: FloatArray, pixels_px: FloatArray, depth_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        basis, slope = self.basis(camera, pixels_px, depth_m)
        return basis @ own, slope @ own

    def by_parameters(
        self, camera: int, own: FloatArray, pixels_px: FloatArray, depth_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        return self.basis(camera, pixels_px, depth_m)

"""What the blocks of the depth's error share: z_true = z + a function of the pixel and of the reported depth."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from functools import cached_property
from typing import ClassVar

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Block, Kind, Scope
from rgbd_calib.rig.sight import Look

MOST_KEPT_BYTES = 2**26
"""Of functions of pixels and depths that one block keeps; beyond, they are computed anew."""
Kept = tuple[FloatArray, ...]


class KeepsFunctions:
    """Functions of pixels and depths, computed once."""

    def kept(self, make: Callable[[], Kept], camera: int, *at: FloatArray) -> Kept:
        """What `make` computes from arrays `at` of a camera, computed once: pixels and reported depths of the corners and
        cells do not change while the rest is solved."""
        key = camera, *((x.shape, x.tobytes()) for x in at)
        found = self._kept.get(key)
        if found is None:
            found = make()
            size = sum(x.nbytes for x in (*found, *at))
            if self._kept_bytes[0] + size <= MOST_KEPT_BYTES:
                self._kept_bytes[0] += size
                self._kept[key] = found
                for x in found:
                    x.flags.writeable = False
        return found

    @cached_property
    def _kept(self) -> dict[tuple[object, ...], Kept]:
        return {}

    @cached_property
    def _kept_bytes(self) -> list[int]:
        return [0]


class DepthErrorBlock(KeepsFunctions, Block):
    """Parameters (C, n) of a correction of the reported depth."""

    scope = Scope.CAMERA
    kinds = frozenset({Kind.DEPTH, Kind.WALL})
    of_alone: ClassVar[bool] = False
    """It corrects the views of intrinsic recordings and no others."""

    @abstractmethod
    def error(
        self, camera: int, own: FloatArray, pixels_px: FloatArray, depth_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """True less reported depth (...), metres, by the camera's parameters (n,), and its slope (...), at pixels (..., 2) of
        the depth image and reported depths (...), metres."""

    @abstractmethod
    def by_parameters(
        self, camera: int, own: FloatArray, pixels_px: FloatArray, depth_m: FloatArray, left_m: FloatArray
    ) -> FloatArray:
        """Derivatives (..., n) of the error + left_m times its slope by the parameters (n,)."""

    def derivative(self, look: Look) -> FloatArray:
        assert look.slope is not None  # rows of depth have it
        own = look.values.get(self.name, np.zeros(self.n))
        out = self.by_parameters(look.camera, own, look.pixels_px, look.depth_m, look.left[..., 0])
        out /= -look.slope[..., None]
        if self.of_alone:
            out *= look.sight.obs.alone[:, None, None]
        return out[..., None, :]


class LinearDepthErrorBlock(DepthErrorBlock):
    """A correction that is linear in its parameters."""

    @abstractmethod
    def basis(self, camera: int, pixels_px: FloatArray, depth_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Functions (..., n) at pixels (..., 2) of the depth image and reported depths (...), metres, and their slopes
        (..., n) by the reported depth."""

    def error(
        self, camera: int, own: FloatArray, pixels_px: FloatArray, depth_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        basis, slope = self._kept_basis(camera, pixels_px, depth_m)
        return basis @ own, slope @ own

    def by_parameters(
        self, camera: int, own: FloatArray, pixels_px: FloatArray, depth_m: FloatArray, left_m: FloatArray
    ) -> FloatArray:
        basis, slope = self._kept_basis(camera, pixels_px, depth_m)
        out = slope * left_m[..., None]
        out += basis
        return out

    def _kept_basis(self, camera: int, pixels_px: FloatArray, depth_m: FloatArray) -> Kept:
        return self.kept(lambda: self.basis(camera, pixels_px, depth_m), camera, pixels_px, depth_m)

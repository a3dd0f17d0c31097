"""What time of flight errs by along the range beyond its bias: its wiggle, from odd harmonics of the light's modulation.

    z_true = z + ... + sum_d c_d P_d(t)        t from -1 to 1 over the range of the depth bias, d from RIPPLE_FROM on

t is of the distance along the pixel's ray, s z, and the error along it, so that z errs by 1 / s of it. Other sensors are
not asked: a curve that bends so often would follow single views whose depth is of another instant.

How large it is, is estimated; where there is nothing it goes to zero.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.polynomial import legendre

from rgbd_calib.geometry.depth_error import RIPPLE_FROM
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import BlockPrior, Component
from rgbd_calib.rig.blocks.depth_bias import DepthBiasBlock
from rgbd_calib.rig.blocks.depth_error import LinearDepthErrorBlock
from rgbd_calib.rig.setup import Setup

DEGREE = 16
"""Four waves over the range: those of time of flight are half a metre long."""
DOF = 0.1
"""Of what is usual: hardly known."""
MOST_M = 0.05


class DepthRipple(LinearDepthErrorBlock):
    """c_d of each camera, metres."""

    name = "depth ripple"

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        return any(prior.time_of_flight for prior in setup.priors)

    @property
    def parameters(self) -> tuple[str, ...]:
        return tuple(f"depth ripple {k}" for k in range(RIPPLE_FROM, DEGREE + 1))

    @cached_property
    def _bias(self) -> DepthBiasBlock:
        return DepthBiasBlock(self.setup)

    def start(self) -> FloatArray:
        out = np.zeros((self.sets, self.n))
        for row, prior in zip(out, self.setup.priors, strict=True):
            if prior.bias is not None:
                row[: len(prior.bias.ripple_m)] = prior.bias.ripple_m
        return out

    def prior(self) -> BlockPrior:
        obs, walls, n = self.setup.obs, self.setup.walls, self.n
        free, components = np.zeros((self.sets, n), bool), []
        for c, prior in enumerate(self.setup.priors):
            seen = bool(np.any(obs.has_depth[obs.camera == c]) or np.any(walls.camera == c))
            free[c] = seen and prior.held == "nothing" and prior.time_of_flight
            name, usual = f"{self.setup.cameras[c]}: depth ripple", self.setup.params.ripple_m
            components.append(Component(name, c * n + np.arange(n), np.eye(n), usual, DOF, MOST_M))
        nothing = np.zeros((self.size,) * 2)
        return BlockPrior(self.start().ravel(), nothing, free.ravel(), np.zeros(self.size, bool), tuple(components))

    def basis(self, camera: int, pixels_px: FloatArray, depth_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        (low, high), s = self._bias.range_m[camera], self._bias.stretch(camera, pixels_px)
        t = np.clip(2 * (depth_m * s - low) / (high - low) - 1, -1, 1)
        inside = np.abs(t) < 1
        by_t = legendre.legder(np.eye(DEGREE + 1)[:, RIPPLE_FROM:])  # (DEGREE, n): derivatives of the shapes as series
        P = legendre.legvander(t, DEGREE)
        slopes = P[..., :DEGREE] @ by_t * ((2 / (high - low)) * inside)[..., None]
        return P[..., RIPPLE_FROM:] / s[..., None], slopes

"""What a depth sensor errs by over its image: polynomials of the pixel, that grow with the depth.

    z_true = z + ... + (z / z0)^(p + q ln(z / z0)) sum_k c_k T_k(u, v)        z0 in the middle of the data

A triangulating sensor errs in disparity, so that p = 2; a time-of-flight camera errs in range, and p is nearer 0; q bends the
line of the error over the depth on double logarithmic paper. Both are estimated; how large the shapes of each degree are, is
too: with nothing to tell it stays at what is usual, and where there is nothing it goes to zero. With z0 elsewhere, what the coefficients are there would depend on p, and
p would go where small ones do.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from rgbd_calib.geometry.depth_error import FIELD_AT_M, n_terms, over_image, terms
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import BlockPrior, Component
from rgbd_calib.rig.blocks.depth_error import DepthErrorBlock, Kept

DEGREE = 8
"""Eight shapes across the image; what is rougher, only walls show."""
BANDS = (1, 2), (3, 5), (6, 8)
"""Degrees whose coefficients are of one size, over the degree: single degrees do not stand out of a lens."""
DOF = 0.001
"""Of what is usual: hardly known, since some sensors err by nothing that is seen."""
MOST = 5.0
"""Times what is usual: a sensor that errs by more is broken. Boards alone would let shapes take what other errors leave."""
GROWTH, GROWTH_SD = np.array([2.0, 0.0]), np.array([0.3, 0.2])
"""Prior of p and q: a Kinect's error in disparity decays towards the camera, by p = 1.4 to 1.8."""
GROWTH_OF_TOF, GROWTH_OF_TOF_SD = np.array([0.5, 0.0]), np.array([0.7, 0.2])
"""Of an error in range, and of what grows with the noise."""


class DepthField(DepthErrorBlock):
    """Coefficients of products of Legendre polynomials by degree from 1 on, the degree 0 being the bias's; then p and q."""

    name = "depth field"

    @property
    def parameters(self) -> tuple[str, ...]:
        return (*(f"depth field {k}" for k in range(1, n_terms(DEGREE))), "growth of the depth field p", "q")

    @cached_property
    def at_m(self) -> FloatArray:
        """(C,), z0: the geometric mean of the camera's depths."""
        obs, walls, out = self.setup.obs, self.setup.walls, np.full(self.sets, FIELD_AT_M)
        for c in range(self.sets):
            boards, cells = (obs.camera == c)[:, None] & obs.has_depth, (walls.camera == c)[:, None] & walls.seen
            z = np.concatenate([obs.depth_m[boards], walls.depth_m[cells]])
            if len(z):
                out[c] = np.exp(np.mean(np.log(z)))
        return out

    def start(self) -> FloatArray:
        out = np.zeros((self.sets, self.n))
        for row, prior in zip(out, self.setup.priors, strict=True):
            row[-2:] = GROWTH_OF_TOF if prior.time_of_flight else GROWTH
        return out

    def prior(self) -> BlockPrior:
        own, n = self.setup, self.n
        degree = np.concatenate([np.full(d + 1, d) for d in range(1, DEGREE + 1)])
        mean, information = self.start(), np.zeros((self.sets, n))
        tof = np.array([prior.time_of_flight for prior in own.priors])
        information[:, -2:] = np.where(tof[:, None], GROWTH_OF_TOF_SD, GROWTH_SD) ** -2.0
        free, components = np.zeros((self.sets, n), bool), []
        for c in range(self.sets):
            free[c] = bool(np.any(own.obs.has_depth[own.obs.camera == c]) or np.any(own.walls.camera == c))
            usual = own.params.field_m * (self.at_m[c] / FIELD_AT_M) ** mean[c, -2]
            for low, high in BANDS:
                at = np.flatnonzero((degree >= low) & (degree <= high))
                name = f"{own.cameras[c]}: depth field {low} to {high}"
                components.append(Component(name, c * n + at, np.diag(degree[at] ** 2.0), usual, DOF, MOST * usual))
        assumed = np.zeros(self.size, bool)
        return BlockPrior(mean.ravel(), np.diag(information.ravel()), free.ravel(), assumed, tuple(components))

    def error(
        self, camera: int, own: FloatArray, pixels_px: FloatArray, depth_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        pattern, (p, q) = self._shapes(camera, pixels_px) @ own[:-2], own[-2:]
        log = np.log(depth_m / self.at_m[camera])
        error = pattern * np.exp((p + q * log) * log)
        return error, error / depth_m * (p + 2 * q * log)

    def by_parameters(
        self, camera: int, own: FloatArray, pixels_px: FloatArray, depth_m: FloatArray, left_m: FloatArray
    ) -> FloatArray:
        T, (p, q), log = self._shapes(camera, pixels_px), own[-2:], np.log(depth_m / self.at_m[camera])
        grown, pattern = np.exp((p + q * log) * log), T @ own[:-2]
        slope = left_m / depth_m
        both = grown * (1 + slope * (p + 2 * q * log))
        out = np.empty((*T.shape[:-1], self.n))
        np.multiply(T, both[..., None], out=out[..., :-2])
        out[..., -2] = pattern * (both * log + slope * grown)
        out[..., -1] = pattern * (both * log + 2 * slope * grown) * log
        return out

    def _shapes(self, camera: int, pixels_px: FloatArray) -> FloatArray:
        def make() -> Kept:
            x, y = over_image(pixels_px, self.setup.sizes_px[camera])
            return (np.asarray(terms(x, y, DEGREE)[..., 1:]),)

        return self.kept(make, camera, pixels_px)[0]

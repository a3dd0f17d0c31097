"""What a depth sensor errs by over its image: polynomials of the pixel, for each of some powers of the depth.

A triangulating sensor errs in disparity, so that the error grows as z^2; a time-of-flight camera errs in range. How large each
is, is estimated with the rest: with nothing to tell, it stays at what is usual, and with nothing there it goes to zero.
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.depth_error import n_terms, over_image, terms
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import BlockPrior, Component
from rgbd_calib.rig.blocks.depth_error import DepthErrorBlock

DEGREE = 6
"""Six shapes across the image; what is rougher belongs to single pixels."""
POWERS = (1, 2)
DOF = 2.0
"""Of what is usual: known to a factor of two."""


class DepthField(DepthErrorBlock):
    """Coefficients of products of Legendre polynomials, by power and then by degree; the degree 0 is the bias's."""

    name = "depth field"

    @property
    def parameters(self) -> tuple[str, ...]:
        return tuple(f"depth field z^{p} {k}" for p in POWERS for k in range(1, n_terms(DEGREE)))

    def prior(self) -> BlockPrior:
        own, n, size = self.setup, n_terms(DEGREE) - 1, self.size
        degree = np.concatenate([np.full(d + 1, d) for d in range(1, DEGREE + 1)])
        free, components = np.zeros((self.sets, self.n), bool), []
        for c in range(self.sets):
            free[c] = bool(np.any(own.obs.has_depth[own.obs.camera == c]) or np.any(own.walls.camera == c))
            for k, power in enumerate(POWERS):
                at = c * self.n + k * n + np.arange(n)
                name = f"{own.cameras[c]}: depth field z^{power}"
                components.append(Component(name, at, np.diag(degree.astype(float) ** 2), own.params.field_per_m, DOF))
        return BlockPrior(np.zeros(size), np.zeros((size, size)), free.ravel(), np.zeros(size, bool), tuple(components))

    def basis(self, camera: int, pixels_px: FloatArray, depth_m: FloatArray) -> FloatArray:
        T = self._shapes(camera, pixels_px)
        return np.concatenate([T * depth_m[..., None] ** p for p in POWERS], axis=-1)

    def basis_slope(self, camera: int, pixels_px: FloatArray, depth_m: FloatArray) -> FloatArray:
        T = self._shapes(camera, pixels_px)
        return np.concatenate([p * T * depth_m[..., None] ** max(p - 1, 0) for p in POWERS], axis=-1)

    def _shapes(self, camera: int, pixels_px: FloatArray) -> FloatArray:
        x, y = over_image(pixels_px, self.setup.sizes_px[camera])
        return np.asarray(terms(x, y, DEGREE)[..., 1:])

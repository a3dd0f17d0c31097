"""What the lens model does not follow: a smooth field of the corners' pixels over the image.

The lens has radial coefficients up to the fifth power, of which the fourth degree catches what they miss.
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.depth_error import n_terms, over_image, terms
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Block, Fault, Kind, Scope
from rgbd_calib.rig.sight import Look

DEGREE = 4


class PixelField(Block):
    """Coefficients of Legendre polynomials over the image, of u and then of v."""

    name = "pixel field"
    scope = Scope.CAMERA
    kinds = frozenset({Kind.PIXEL})
    least_seen = 1e-2
    """Poses and lens have what is smoother but for their priors, of which noisy corners leave up to 6e-4; the next leaves 2.6e-2."""
    held = Fault(
        "pixels over the image",
        lambda t: (
            f"{t.camera}'s corners are off by a smooth field over its image, {t.mm} RMS at the board: the lens model does not "
            "follow this lens"
        ),
        "Check that all images are of one size and crop, and free of a window's refraction; a wide lens needs another model",
    )

    @property
    def parameters(self) -> tuple[str, ...]:
        return tuple(f"field of {axis} {k}" for axis in "uv" for k in range(n_terms(DEGREE)))

    def derivative(self, look: Look) -> FloatArray:
        T = terms(*over_image(look.pixels_px, self.setup.sizes_px[look.camera]), DEGREE)
        out = np.zeros((*T.shape[:2], 2, self.n))
        half = T.shape[-1]
        out[:, :, 0, :half] = out[:, :, 1, half:] = T
        return out

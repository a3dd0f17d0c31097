"""What a depth sensor errs by over its image: polynomials of the pixel, in proportion to the depth."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.depth_error import n_terms, over_image, terms
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Fault
from rgbd_calib.rig.blocks.depth_error import DepthErrorBlock

DEGREE = 3
"""A tilt, a bowl, an S."""


class DepthField(DepthErrorBlock):
    """Coefficients of Legendre polynomials over the image."""

    name = "depth field"
    held = Fault(
        "depth over the image",
        lambda t: (
            f"{t.camera}'s depth is off by a smooth field over its image, {t.mm} RMS: its bias is not of the depth alone"
        ),
        "Expect this error in fused clouds; an unusual sensor may be damaged or hot",
    )

    @property
    def parameters(self) -> tuple[str, ...]:
        return tuple(f"depth field {k}" for k in range(1, n_terms(DEGREE)))

    def basis(self, camera: int, pixels_px: FloatArray, depth_m: FloatArray) -> FloatArray:
        x, y = over_image(pixels_px, self.setup.sizes_px[camera])
        return np.asarray(terms(x, y, DEGREE)[..., 1:] * depth_m[..., None])

    def basis_slope(self, camera: int, pixels_px: FloatArray, depth_m: FloatArray) -> FloatArray:
        x, y = over_image(pixels_px, self.setup.sizes_px[camera])
        return np.asarray(terms(x, y, DEGREE)[..., 1:])

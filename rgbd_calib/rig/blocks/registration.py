"""Depth that stands beside its colour: the driver's idea of both cameras is not quite right.

Depth that is reported at pixel q of the colour image was measured of what colour shows at q - d. On the board's plane, with
the normal n and a corner p = z (x, y, 1) in the camera's frame, depth is then

    z' = z (n . p) / (n . (p - z (d_u / fx, d_v / fy, 0)))
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Block, Fault, Kind, Scope, Told
from rgbd_calib.rig.sight import Look

_ADVICE = "Register depth to colour with the sensor's own software (capture does), or correct the registration"


def _say(t: Told) -> str:
    return (
        f"{t.camera}'s depth is misregistered to colour by {t.estimate[0]:+.1f} px in u and {t.estimate[1]:+.1f} px in v, or "
        f"{t.mm} at the board"
    )


class Registration(Block):
    """Shift of the depth image in u and v, px."""

    name = "registration"
    scope = Scope.CAMERA
    kinds = frozenset({Kind.DEPTH})
    held = Fault("registration", _say, _ADVICE)
    of_all = Fault("registration of all", _say, _ADVICE)

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("registration in u", "registration in v")

    def derivative(self, look: Look) -> FloatArray:
        lens = self.setup.priors[look.camera].intrinsics
        p, n = look.sight.p_color, look.sight.normal_color
        along = np.einsum("vi,vni->vn", n, p / p[..., 2:])
        safe = np.where(np.abs(along) > 0.05, along, np.inf)  # edge on there is no slope
        return np.asarray((p[..., 2:] * n[:, None, :2] / np.array([lens.fx, lens.fy]) / safe[..., None])[:, :, None])

    def effect(self, distance_m: float, lateral_m: float) -> FloatArray:
        return lateral_m**2 * np.eye(2)

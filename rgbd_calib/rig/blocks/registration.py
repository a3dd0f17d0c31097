"""Depth that stands beside its colour: the driver's idea of both cameras is not quite right.

What the colour image shows at pixel q, the depth image shows at q + d,

    d_u = a + m_u (u - cx) - t (v - cy) + fx b_x / z          d_v = c + m_v (v - cy) + t (u - cx) + fy b_y / z

with a shift (a, c), a magnification (m_u, m_v), a turn t and a wrong baseline (b_x, b_y). So what the depth image reports at
pixel q is the depth of what colour shows at q - d. On the board's plane, with the normal n and a corner p = z (x, y, 1) in
the camera's frame, that is

    z' = z / (1 - s)          s = z (n_x d_u / fx + n_y d_v / fy) / (n . p)
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.depth_sensor import DepthCamera
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Block, BlockPrior, Kind, Scope
from rgbd_calib.rig.sight import Look


class Registration(Block):
    """a, c (px), m_u, m_v, t (rad), b_x, b_y (m) of each camera."""

    name = "registration"
    scope = Scope.CAMERA
    kinds = frozenset({Kind.DEPTH})

    @property
    def parameters(self) -> tuple[str, ...]:
        return (
            "registration in u", "registration in v", "magnification of depth in u", "magnification of depth in v",
            "turn of the depth image", "baseline of depth in x", "baseline of depth in y",
        )  # fmt: skip

    def prior(self) -> BlockPrior:
        own, obs, n = self.setup.params, self.setup.obs, self.size
        px, scale, baseline = own.registration_sd_px, own.registration_scale_sd, own.registration_baseline_sd_m
        sd = np.array([px, px, scale, scale, own.registration_turn_sd_rad, baseline, baseline])
        free = [bool(np.any(obs.has_depth[obs.camera == c])) for c in range(self.sets)]
        held = [prior.held != "nothing" or prior.same_sensor for prior in self.setup.priors]
        information = np.diag(np.tile(sd**-2.0, self.sets))
        return BlockPrior(
            np.zeros(n), information, np.repeat(np.array(free) & ~np.array(held), self.n), np.zeros(n, bool)
        )

    def by_parameters(self, camera: int, pixels_px: FloatArray, depth_m: FloatArray) -> FloatArray:
        """(..., 2, 7), of the shift d at pixels (..., 2) and reported depths (...)."""
        lens = self.setup.priors[camera].intrinsics
        u, v = pixels_px[..., 0] - lens.cx, pixels_px[..., 1] - lens.cy
        out = np.zeros((*depth_m.shape, 2, self.n))
        out[..., 0, 0] = out[..., 1, 1] = 1.0
        out[..., 0, 2], out[..., 1, 3] = u, v
        out[..., 0, 4], out[..., 1, 4] = -v, u
        out[..., 0, 5], out[..., 1, 6] = lens.fx / depth_m, lens.fy / depth_m
        return out

    def changes(self, look: Look) -> bool:
        return look.by_shift is not None

    def derivative(self, look: Look) -> FloatArray:
        assert look.by_shift is not None  # rows of depth have it
        return look.by_shift[:, :, None] @ self.by_parameters(look.camera, look.pixels_px, look.depth_m)


def depth_camera(lens: Intrinsics, values: FloatArray, tilt_rad: FloatArray) -> DepthCamera:
    """The camera that a depth image of this registration (7,) is of, its axis turned by the tilts (2,), which move no pixel."""
    a, c, m_u, m_v, turn, b_x, b_y = values.tolist()
    vector = lens.vector.copy()
    vector[:4] *= [1 + m_u, 1 + m_v, 1.0, 1.0]
    vector[2:4] += [a, c] - vector[:2] * tilt_rad
    T_depth_color = se3.make(so3.exp(np.array([-tilt_rad[1], tilt_rad[0], turn])), np.array([b_x, b_y, 0.0]))
    return DepthCamera(lens.with_vector(vector), se3.inverse(T_depth_color))

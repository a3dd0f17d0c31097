"""Depth that stands beside its colour: the driver's idea of both cameras is not quite right.

What the colour image shows at pixel q, the depth image shows at q + d,

    d_u = a + m_u (u - cx) - t (v - cy) + fx b_x / z          d_v = c + m_v (v - cy) + t (u - cx) + fy b_y / z

with a shift (a, c), a magnification (m_u, m_v), a turn t and a wrong baseline (b_x, b_y). So what the depth image reports at
pixel q is the depth of what colour shows at q - d, along the ray (x - e_x, y - e_y, 1), e = (dq / d(x, y))^-1 d by the lens.
On the board's plane, with the normal n and a corner p = z (x, y, 1) in the camera's frame, that is

    z' = z / (1 - s)          s = z (n_x e_x + n_y e_y) / (n . p)
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from rgbd_calib.geometry import camera as camera_model
from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.depth_sensor import DepthCamera
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Block, BlockPrior, Kind, Scope
from rgbd_calib.rig.blocks.depth_error import KeepsFunctions
from rgbd_calib.rig.sight import Look


class Registration(KeepsFunctions, Block):
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
        """(..., 2, 7), of the turn e of the ray at pixels (..., 2) and reported depths (...)."""
        return self.kept(lambda: (self._by_parameters(camera, pixels_px, depth_m),), camera, pixels_px, depth_m)[0]

    def _by_parameters(self, camera: int, pixels_px: FloatArray, depth_m: FloatArray) -> FloatArray:
        lens = self.setup.priors[camera].intrinsics
        u, v = pixels_px[..., 0] - lens.cx, pixels_px[..., 1] - lens.cy
        of_pixel = np.zeros((*depth_m.shape, 2, 5))
        of_pixel[..., 0, 0] = of_pixel[..., 1, 1] = 1.0
        of_pixel[..., 0, 2], of_pixel[..., 1, 3] = u, v
        of_pixel[..., 0, 4], of_pixel[..., 1, 4] = -v, u
        rays = lens.rays(pixels_px)
        rays = np.where(np.isfinite(rays), rays, [0.0, 0.0, 1.0])
        pixel_by_ray = camera_model.project_jacobian(lens.vector, rays, lens.model)[1][..., :2]
        of_baseline = np.broadcast_to(np.eye(2), (*depth_m.shape, 2, 2)) / depth_m[..., None, None]
        return np.concatenate([np.linalg.solve(pixel_by_ray, of_pixel), of_baseline], axis=-1)

    def changes(self, look: Look) -> bool:
        return look.by_turn is not None

    def derivative(self, look: Look) -> FloatArray:
        assert look.by_turn is not None  # rows of depth have it
        return look.by_turn[:, :, None] @ self.by_parameters(look.camera, look.pixels_px, look.depth_m)


def turn_of_rays(
    blocks: Iterable[Block], values: Mapping[str, FloatArray], camera: int, pixels_px: FloatArray, depth_m: FloatArray
) -> FloatArray:
    """e (..., 2) at pixels (..., 2) and reported depths (...), metres, by the values of all blocks of this kind."""
    out = np.zeros(pixels_px.shape)
    for block in blocks:
        if isinstance(block, Registration) and np.any(values[block.name][camera]):
            out += block.by_parameters(camera, pixels_px, depth_m) @ values[block.name][camera]
    return out


def depth_camera(lens: Intrinsics, values: FloatArray, tilt_rad: FloatArray) -> DepthCamera:
    """The camera that a depth image of this registration (7,) is of, its axis turned by the tilts (2,), which move no pixel."""
    a, c, m_u, m_v, turn, b_x, b_y = values.tolist()
    vector = lens.vector.copy()
    vector[:4] *= [1 + m_u, 1 + m_v, 1.0, 1.0]
    vector[2:4] += [a, c] - vector[:2] * tilt_rad
    T_depth_color = se3.make(so3.exp(np.array([-tilt_rad[1], tilt_rad[0], turn])), np.array([b_x, b_y, 0.0]))
    return DepthCamera(lens.with_vector(vector), se3.inverse(T_depth_color))

"""A camera at a place in the room: the rays of its pixels, through the full lens model."""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.scene import Scene


class View:
    """A camera at a place in a room: rays of its pixels, in the room's frame, with z = 1 in its own."""

    def __init__(self, intrinsics: Intrinsics, T_room_color: FloatArray) -> None:
        self.intrinsics = intrinsics
        self.origin_m = T_room_color[:3, 3]
        R_room_color = self._R_room_color = T_room_color[:3, :3]
        v, u = np.mgrid[-1 : intrinsics.height + 1, -1 : intrinsics.width + 1].astype(float)
        grid = intrinsics.rays(np.stack([u, v], axis=-1))
        self.in_camera = grid[1:-1, 1:-1].reshape(-1, 3)
        """Directions (h * w, 3) through the middles of all pixels, row by row, in the camera's frame."""
        self.centres = self.in_camera @ R_room_color.T
        """The same in the room's frame."""
        # within a pixel the lens is straight to 1e-4 px: its second derivative is 6 k1 x / f^2
        self._along_u = ((grid[1:-1, 2:] - grid[1:-1, :-2]) / 2).reshape(-1, 3) @ R_room_color.T
        self._along_v = ((grid[2:, 1:-1] - grid[:-2, 1:-1]) / 2).reshape(-1, 3) @ R_room_color.T

    @property
    def shape(self) -> tuple[int, int]:
        return self.intrinsics.height, self.intrinsics.width

    def around(self, scene: Scene) -> np.ndarray:
        """Numbers (n,) of the pixels of an upright rectangle that holds all of a scene, given in the room's frame."""
        h, w = self.shape
        c, u, v = scene.corners_m, scene.edges_u_m, scene.edges_v_m
        p = (np.concatenate([c, c + u, c + v, c + u + v]) - self.origin_m) @ self._R_room_color
        x, y = p[:, 0] / p[:, 2], p[:, 1] / p[:, 2]
        if p[:, 2].min() < 0.05:  # beside or behind the camera: no rectangle
            return np.arange(h * w)
        rows, columns = self.in_camera.reshape(h, w, 3)[..., 1], self.in_camera.reshape(h, w, 3)[..., 0]
        low, high = np.array([x.min(), y.min()]) - 0.01, np.array([x.max(), y.max()]) + 0.01
        inside = (columns > low[0]) & (columns < high[0]) & (rows > low[1]) & (rows < high[1])
        return np.flatnonzero(inside)

    def through(self, pixels: np.ndarray, offsets_px: FloatArray) -> FloatArray:
        """Directions (n, s, 3), in the room's frame, at `offsets_px` (n, s, 2) from the middles of pixels (n,)."""
        return (
            self.centres[pixels, None]
            + offsets_px[..., :1] * self._along_u[pixels, None]
            + offsets_px[..., 1:] * self._along_v[pixels, None]
        )

    def on_plane(
        self, pixels: np.ndarray, offsets_px: FloatArray, normal: FloatArray, d_m: float, axis: FloatArray
    ) -> FloatArray:
        """Coordinates (n, s) along `axis` (3,), from the eye, of where these rays meet the plane that lies `d_m` from
        the eye along `normal` (3,): the same as by :meth:`through`, with few products."""
        up, down = (
            (self.centres[pixels] @ a)[:, None]
            + offsets_px[..., 0] * (self._along_u[pixels] @ a)[:, None]
            + offsets_px[..., 1] * (self._along_v[pixels] @ a)[:, None]
            for a in (axis, normal)
        )
        return d_m * up / down

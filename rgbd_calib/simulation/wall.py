"""A wall in front of a camera for depth calibration: light paint with a cross of tape on the optical axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.quality import TrueWall
from rgbd_calib.simulation import textures
from rgbd_calib.simulation.render import IdealImage
from rgbd_calib.simulation.view import View

_PAINT = textures.plain("wall", "d9d3c5")
WALL_COLOR = textures.linear(np.array(_PAINT.colors[0]))
"""Linear."""
_TAPE = textures.hex_color("3c5f8a")
_TAPE_WIDTH_M, _TAPE_LENGTH_M = 0.019, 0.3


@dataclass(frozen=True)
class Wall:
    """A plane in the frame of a camera."""

    distance_m: float
    """From the optical centre along the optical axis."""
    normal: FloatArray
    """(3,), away from the camera; (0, 0, 1) is square to it."""

    def z_m(self, view: View) -> FloatArray:
        """Depth (h, w) along the axis of a camera with this frame."""
        return self.along(view.in_camera).reshape(view.shape)

    def along(self, rays: FloatArray) -> FloatArray:
        """Depth (n,) along rays (n, 3) of z = 1."""
        return np.asarray(self.distance_m * self.normal[2] / (rays @ self.normal))

    def cos_incidence(self, view: View) -> FloatArray:
        """(h, w) between ray and wall."""
        rays = view.in_camera
        return np.asarray((np.abs(rays @ self.normal) / np.linalg.norm(rays, axis=1)).reshape(view.shape))

    def moved(self, T_other_camera: FloatArray) -> Wall:
        """The same wall in another camera's frame."""
        normal = T_other_camera[:3, :3] @ self.normal
        offset = self.normal[2] * self.distance_m + normal @ T_other_camera[:3, 3]
        return Wall(float(offset / normal[2]), normal)


@dataclass(frozen=True)
class TapedWall:
    """A wall and its distance as measured by tape."""

    wall: Wall
    distance_m: float
    sd_m: float = 0.0
    """Stated standard deviation; 0: none, the distance is exact."""

    @property
    def written(self) -> tuple[str, ...]:
        """Distance and, if stated, standard deviation, as written in distances.csv."""
        return (f"{self.distance_m:.3f}", f"{self.sd_m:g}") if self.sd_m else (f"{self.distance_m:.4f}",)

    @property
    def truth(self) -> TrueWall:
        """For truth.yaml."""
        return TrueWall(self.wall.distance_m, self.wall.normal)


SQUARE = np.array([0.0, 0.0, 1.0])


def tilted(most_rad: float, rng: np.random.Generator) -> FloatArray:
    """Normal (3,) of a wall tilted by at most `most_rad`, uniformly distributed."""
    way, tilt = rng.uniform(0, 2 * np.pi), most_rad * np.sqrt(rng.random())
    return np.array([np.sin(tilt) * np.cos(way), np.sin(tilt) * np.sin(way), np.cos(tilt)])


def render_wall(view: View, wall: Wall, rng: np.random.Generator) -> IdealImage:
    """The picture of an endless wall."""
    h, w = view.shape
    z_m = wall.z_m(view)
    on_wall = view.in_camera * z_m.reshape(-1, 1)  # (h * w, 3)
    x, y = on_wall[:, 0], on_wall[:, 1]
    albedo = textures.albedo(_PAINT, x, y, np.full(len(x), float(rng.integers(1000))))
    pixel_m = wall.distance_m / view.intrinsics.fx
    for a, b in ((x, y), (y, x)):
        # the tape's share of each pixel, edges spread over one pixel
        share = np.clip((_TAPE_WIDTH_M / 2 - np.abs(a)) / pixel_m + 0.5, 0, 1)
        share *= np.clip((_TAPE_LENGTH_M / 2 - np.abs(b)) / pixel_m + 0.5, 0, 1)
        albedo = albedo * (1 - share[:, None]) + textures.linear(np.array(_TAPE)) * share[:, None]
    light = 0.75 / (1 + 0.08 * (x**2 + (y + 0.5) ** 2))
    image = (albedo * light[:, None]).astype(np.float32).reshape(h, w, 3)
    cos: FloatArray = np.abs(on_wall @ wall.normal) / np.linalg.norm(on_wall, axis=1)
    return IdealImage(image, z_m, cos.reshape(h, w))

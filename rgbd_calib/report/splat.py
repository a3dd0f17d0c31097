"""Pictures of point clouds without a display or a graphics card: z-buffered squares, shaded by the depth buffer.

Eye-dome lighting (C. Boucheny, thesis, Grenoble 2009): a pixel is darkened by how far its neighbours stand in front of
it, so that shapes show without normals.
"""

from __future__ import annotations

import colorsys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray

VIEWS = ("front", "back", "left", "right", "top", "oblique")
"""Where the viewer stands. Front is behind the cameras, looking where they look."""

_COLORS = ((230, 25, 25), (30, 170, 40), (40, 70, 240), (225, 30, 225), (255, 140, 0), (0, 180, 190), (130, 80, 40))
_OVERSAMPLE = 2
_SHADE = 6.0  # strength of the shading, by eye
_OVERLAP_SHARE = 0.01  # cell of the grid that tells where clouds overlap, as share of their extent
_OVERLAP_CELLS = 30  # fewer are chance contacts
_FIELD_RAD = np.radians(40.0)


@dataclass(frozen=True)
class Viewpoint:
    """A pinhole viewer; the rows of R_view_world are its right, down and forward."""

    R_view_world: FloatArray
    center_m: FloatArray
    """(3,), point of the world in the middle of the picture."""
    radius_m: float
    """Half the side of what the picture shows at that point."""


def camera_color(index: int) -> tuple[int, int, int]:
    """R, G, B of camera number `index`: red, green, blue, magenta (the paper's figure 11), then others, without end."""
    if index < len(_COLORS):
        return _COLORS[index]
    r, g, b = colorsys.hsv_to_rgb((index * 0.618034) % 1.0, 0.75, 0.8)  # the golden ratio keeps neighbours apart
    return round(255 * r), round(255 * g), round(255 * b)


def viewpoint(name: str, T_world_color: Iterable[FloatArray], points_m: FloatArray) -> Viewpoint:
    """A view of points (n, 3), metres, in the world, from one of `VIEWS`.

    The first camera is the one that decides where cameras look every way (a ring).
    """
    R = np.array([T[:3, :3] for T in T_world_color])
    down = _unit(R[:, :, 1].mean(axis=0), R[0, :, 1])
    forward = R[:, :, 2].mean(axis=0)
    forward -= down * (down @ forward)
    if np.linalg.norm(forward) < 0.3:
        forward = R[0, :, 2] - down * (down @ R[0, :, 2])
    forward = _unit(forward, R[0, :, 0])
    right = np.cross(down, forward)
    axes = {
        "front": forward,
        "back": -forward,
        "left": right,
        "right": -right,
        "top": 0.9999 * down + 0.0141 * forward,
        "oblique": 0.65 * forward + 0.5 * down + 0.57 * right,
    }
    z = _unit(axes[name], forward)
    x = np.cross(down, z)
    x = _unit(x, right)
    low, high = np.percentile(points_m, [1, 99], axis=0)
    R_view_world = np.stack([x, np.cross(z, x), z])
    center_m = (low + high) / 2
    spread = (points_m - center_m) @ R_view_world[:2].T
    return Viewpoint(R_view_world, center_m, max(float(np.percentile(np.abs(spread), 99)), 1e-3))


def seen_by_several(clouds_m: Sequence[FloatArray]) -> FloatArray:
    """Points (n, 3) near which at least two clouds have points: where misalignment shows. All, where there are few."""
    everything = np.concatenate(clouds_m)
    low, high = np.percentile(everything, [1, 99], axis=0)
    voxel_m = max(float(np.max(high - low)) * _OVERLAP_SHARE, 1e-6)
    cells = [np.unique(np.floor(cloud / voxel_m).astype(np.int64), axis=0) for cloud in clouds_m]
    occupied, counts = np.unique(np.concatenate(cells), axis=0, return_counts=True)
    centers_m = np.asarray((occupied[counts > 1] + 0.5) * voxel_m, float)
    return centers_m if len(centers_m) >= _OVERLAP_CELLS else everything


def render(
    points_m: FloatArray, colors: np.ndarray, view: Viewpoint, width: int = 960, height: int = 720
) -> np.ndarray:
    """Picture (height, width, 3), uint8, R G B, on white, of points (n, 3), metres, with colours (n, 3), uint8."""
    wide, high = width * _OVERSAMPLE, height * _OVERSAMPLE
    focal = 0.5 * min(wide, high) / np.tan(_FIELD_RAD / 2)
    distance_m = 1.15 * view.radius_m / np.tan(_FIELD_RAD / 2)
    p = (points_m - view.center_m) @ view.R_view_world.T + [0, 0, distance_m]
    number = np.nonzero(p[:, 2] > 0.05 * distance_m)[0]
    p = p[number]
    u = np.rint(focal * p[:, 0] / p[:, 2] + wide / 2).astype(np.int64)
    v = np.rint(focal * p[:, 1] / p[:, 2] + high / 2).astype(np.int64)
    # one integer holds depth and point: the nearest point wins, and points of equal depth by their number
    depth = np.minimum(p[:, 2] / distance_m * 2**24, 2**31 - 1).astype(np.uint64)
    key = (depth << np.uint64(32)) | number.astype(np.uint64)
    empty = np.iinfo(np.uint64).max
    buffer = np.full(wide * high, empty)
    for dv in range(-_OVERSAMPLE + 1, _OVERSAMPLE + 1):
        for du in range(-_OVERSAMPLE + 1, _OVERSAMPLE + 1):
            inside = (u + du >= 0) & (u + du < wide) & (v + dv >= 0) & (v + dv < high)
            np.minimum.at(buffer, (v[inside] + dv) * wide + u[inside] + du, key[inside])
    hit = buffer != empty
    picture = np.full((wide * high, 3), 255.0)
    picture[hit] = colors[(buffer[hit] & np.uint64(2**32 - 1)).astype(np.int64)]
    z = np.where(hit, (buffer >> np.uint64(32)) / 2**24, np.inf).reshape(high, wide)
    picture = picture.reshape(high, wide, 3) * _shade(z)[..., None]
    small = picture.reshape(height, _OVERSAMPLE, width, _OVERSAMPLE, 3).mean(axis=(1, 3))
    return np.asarray(np.rint(small), np.uint8)


def with_scale(picture: np.ndarray, view: Viewpoint, bar_m: float) -> np.ndarray:
    """The picture with a bar of `bar_m` metres, as long as such a thing is at the viewpoint's centre."""
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    height, width = picture.shape[:2]
    length = bar_m * 0.5 * min(width, height) / (1.15 * view.radius_m)
    size = max(12, width // 45)
    y = height - size
    draw.rectangle((16, y - 4, 16 + length, y), fill=(0, 0, 0))
    draw.text((16, y - 8), f"{1e3 * bar_m:g} mm", (0, 0, 0), ImageFont.load_default(size), anchor="lb")
    return np.array(image)


def with_legend(picture: np.ndarray, labels: Mapping[str, tuple[int, int, int]]) -> np.ndarray:
    """The picture with one line of text for each label, in its colour, in the top left corner."""
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    size = max(12, picture.shape[0] // 40)
    font = ImageFont.load_default(size)
    for i, (text, color) in enumerate(labels.items()):
        draw.text((10, 8 + i * 1.35 * size), text, color, font, stroke_width=2, stroke_fill=(255, 255, 255))
    return np.array(image)


def _shade(z: FloatArray) -> FloatArray:
    """Brightness (h, w) in (0, 1] from the depth buffer, inf where nothing is."""
    log_z = np.log2(np.where(np.isfinite(z), z, np.nan))
    total = np.zeros_like(z)
    for dv, du in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        neighbour = np.roll(log_z, (dv, du), (0, 1))
        total += np.nan_to_num(np.clip(log_z - neighbour, 0, 0.1))
    return np.exp(-_SHADE * total)


def _unit(v: FloatArray, otherwise: FloatArray) -> FloatArray:
    length = np.linalg.norm(v)
    return v / length if length > 1e-6 else otherwise

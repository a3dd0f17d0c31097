"""Colour images by supersampled ray casting through the full lens model.

A pixel is the mean of the light over its square: rays are spread evenly over it, by geometry.camera.rays, so that
edges are where the projection puts them. Only pixels that an edge of the board crosses get many rays; the room does
not move, so each camera's picture of it is made once. Lens blur, noise and the sRGB curve come last.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rgbd_calib.geometry.camera import Intrinsics, rays
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.synthetic import textures
from rgbd_calib.synthetic.scene import Caster, Hits, Scene

ROOM_SAMPLES = 16
EDGE_SAMPLES = 32
_CHUNK_RAYS = 400_000

_AMBIENT = np.array([0.44, 0.43, 0.42])
_BOUNCE_FAR_M = 0.9
"""Surfaces nearer than this take away light from all around."""


@dataclass(frozen=True)
class Light:
    """A rectangle that gives light: a lamp under the ceiling, a window."""

    corner_m: FloatArray
    u_m: FloatArray
    v_m: FloatArray
    normal: FloatArray
    power: FloatArray
    """(3,) RGB: irradiance is power cos cos' / distance^2, metres."""


LIGHTS = (
    Light(np.array([-1.0, -0.6, 2.655]), np.array([2.0, 0, 0]), np.array([0, 1.2, 0]), np.array([0, 0, -1.0]),
          np.array([3.3, 3.12, 2.8])),
    Light(np.array([3.37, 0.15, 0.95]), np.array([0, 1.7, 0]), np.array([0, 0, 1.35]), np.array([-1.0, 0, 0]),
          np.array([3.0, 3.4, 3.9])),
)  # fmt: skip


_LAMP_PLACES = np.array([[[0.25, 0.25]], [[0.25, 0.75]], [[0.75, 0.25]], [[0.75, 0.75]]])
"""Where on a light its four parts stand for the whole, where there are no shadows."""


@dataclass(frozen=True)
class ColorNoise:
    """Lens and sensor of the colour camera."""

    blur_px: float = 0.6
    """Deviation of the lens's point spread, beside the pixel's own square."""
    sigma_grey: float = 1.5
    """Noise at middle grey, in steps of 255; it grows with the root of the light."""
    vignette: float = 0.12
    """Light lost in the image's corners."""


class View:
    """A camera at a place in a room: rays of its pixels, in the room's frame, with z = 1 in its own."""

    def __init__(self, intrinsics: Intrinsics, T_room_color: FloatArray) -> None:
        self.intrinsics = intrinsics
        self.origin_m = T_room_color[:3, 3]
        self.R_room_color = T_room_color[:3, :3]
        # one ray a pixel, one pixel more all round; between them the lens is straight to 1e-4 px (6 k1 x / f^2 / 8)
        v, u = np.mgrid[-1 : intrinsics.height + 1, -1 : intrinsics.width + 1].astype(float)
        self._grid = rays(intrinsics.vector, np.stack([u, v], axis=-1))

    @property
    def shape(self) -> tuple[int, int]:
        return self.intrinsics.height, self.intrinsics.width

    def in_camera(self) -> FloatArray:
        """Directions (h * w, 3) through the middles of all pixels, z = 1, in the camera's frame."""
        return self._grid[1:-1, 1:-1].reshape(-1, 3)

    def centres(self) -> FloatArray:
        """Directions (h * w, 3) through the middles of all pixels, in the room's frame."""
        flat: FloatArray = self.in_camera() @ self.R_room_color.T
        return flat

    def through(self, pixels_px: FloatArray) -> FloatArray:
        """Directions (n, 3) through pixels (n, 2) at most half a pixel outside the image, in the room's frame."""
        u, v = pixels_px[:, 0] + 1, pixels_px[:, 1] + 1
        i, j = np.floor(u).astype(int), np.floor(v).astype(int)
        a, b = (u - i)[:, None], (v - j)[:, None]
        g = self._grid
        top, bottom = g[j, i] * (1 - a) + g[j, i + 1] * a, g[j + 1, i] * (1 - a) + g[j + 1, i + 1] * a
        flat: FloatArray = (top * (1 - b) + bottom * b) @ self.R_room_color.T
        return flat


@dataclass(frozen=True)
class Picture:
    """What an ideal camera sees: no blur, no noise."""

    light: FloatArray
    """(h, w, 3) linear RGB, float32."""
    z_m: FloatArray
    """(h, w) depth along the optical axis at the middles of the pixels, inf where nothing is."""
    cos_incidence: FloatArray
    """(h, w) between ray and surface."""


def render_room(view: View, caster: Caster, rng: np.random.Generator, samples: int = ROOM_SAMPLES) -> Picture:
    """The room as one camera sees it, with soft shadows."""
    h, w = view.shape
    light = np.empty((h * w, 3), np.float32)
    rows = max(1, _CHUNK_RAYS // (samples * w))
    for first in range(0, h, rows):
        pixels = np.arange(first * w, min(first + rows, h) * w)
        light[pixels] = _supersample(view, pixels, [caster], caster, rng, samples)
    centres = view.centres()
    hits = caster.cast(view.origin_m, centres)
    cos = _cos_incidence(caster.scene, hits, centres)
    return Picture(light.reshape(h, w, 3), hits.t.reshape(h, w), cos.reshape(h, w))


def render_with_board(
    view: View, room: Picture, room_caster: Caster, board_caster: Caster, rng: np.random.Generator
) -> Picture:
    """The room's picture with the board (and its stand) put in front of it."""
    h, w = view.shape
    centres = view.centres()
    hits = board_caster.cast(view.origin_m, centres)
    scene = board_caster.scene
    front = hits.t < room.z_m.ravel()
    patch = np.zeros(h * w, int)
    patch[front] = 1 + _patches(scene, hits.quad[front], _points(view, centres[front], hits.t[front]))
    light = room.light.reshape(-1, 3).copy()
    image = patch.reshape(h, w).astype(np.float32)  # exact: there are fewer than 2^24 patches
    crossed = (cv2.dilate(image, np.ones((3, 3))) != cv2.erode(image, np.ones((3, 3)))).ravel()
    # a middle and its eight neighbours on one patch: one ray shows the pixel's mean
    inside = np.flatnonzero(front & ~crossed)
    points = _points(view, centres[inside], hits.t[inside])
    light[inside] = _radiance(scene, hits.quad[inside], points, view.origin_m, None, None)
    edges = np.flatnonzero(crossed)
    step = max(1, _CHUNK_RAYS // EDGE_SAMPLES)
    for first in range(0, len(edges), step):
        some = edges[first : first + step]
        light[some] = _supersample(view, some, [board_caster, room_caster], room_caster, rng, EDGE_SAMPLES)
    cos = np.where(front, _cos_incidence(scene, hits, centres), room.cos_incidence.ravel())
    z_m = np.where(front, hits.t, room.z_m.ravel())
    return Picture(light.reshape(h, w, 3), z_m.reshape(h, w), cos.reshape(h, w))


def develop(picture: Picture, noise: ColorNoise, rng: np.random.Generator) -> np.ndarray:
    """The image (h, w, 3), uint8, B G R, that the colour camera gives."""
    light = np.asarray(picture.light, np.float32)
    h, w = light.shape[:2]
    if noise.blur_px > 0:
        light = cv2.GaussianBlur(light, (0, 0), noise.blur_px, borderType=cv2.BORDER_REPLICATE)
    y, x = np.mgrid[:h, :w].astype(np.float32)
    r2 = ((x - (w - 1) / 2) ** 2 + (y - (h - 1) / 2) ** 2) / ((w / 2) ** 2 + (h / 2) ** 2)
    light = light * (1 - noise.vignette * r2)[..., None]
    # photon noise: the curve's slope at middle grey (0.214 linear) turns grey steps into light
    middle, slope = 0.214, 1.16
    sigma = noise.sigma_grey / 255 / slope * np.sqrt((np.maximum(light, 0) + 0.02) / (middle + 0.02))
    light = light + sigma * rng.standard_normal(light.shape, dtype=np.float32)
    return np.round(255 * textures.encode(light)).astype(np.uint8)[..., ::-1]


def _supersample(
    view: View,
    pixels: np.ndarray,
    casters: list[Caster],
    shadow_caster: Caster,
    rng: np.random.Generator,
    samples: int,
) -> FloatArray:
    """Mean light (n, 3) over the squares of pixels (n,), row-major numbers; the nearest hit of the casters counts."""
    w = view.intrinsics.width
    middles = np.stack([pixels % w, pixels // w], axis=1).astype(float)
    places = middles[:, None] + _spread(len(pixels), samples, rng) - 0.5
    directions = view.through(places.reshape(-1, 2))
    hits = [caster.cast(view.origin_m, directions) for caster in casters]
    spread = np.stack([_spread(len(pixels), samples, rng).reshape(-1, 2) for _ in range(1 + len(LIGHTS))])
    nearest = np.argmin([h.t for h in hits], axis=0)
    light = np.zeros((len(directions), 3))
    for i, caster in enumerate(casters):
        mine = np.flatnonzero((nearest == i) & np.isfinite(hits[i].t))
        points = _points(view, directions[mine], hits[i].t[mine])
        shadows = shadow_caster if caster is shadow_caster else None
        light[mine] = _radiance(caster.scene, hits[i].quad[mine], points, view.origin_m, shadows, spread[:, mine])
    mean: FloatArray = light.reshape(len(pixels), samples, 3).mean(axis=1)
    return mean


def _spread(n: int, samples: int, rng: np.random.Generator) -> FloatArray:
    """Places (n, samples, 2) spread evenly over the unit square (R2 sequence, M. Roberts 2018), shifted at random
    for each pixel, so that the mean over many pixels has no bias."""
    golden = np.array([0.7548776662466927, 0.5698402909980532])
    places: FloatArray = (np.arange(samples)[:, None] * golden + rng.random((n, 1, 2))) % 1.0
    return places


def _points(view: View, directions: FloatArray, t: FloatArray) -> FloatArray:
    points: FloatArray = view.origin_m + t[:, None] * directions
    return points


def _cos_incidence(scene: Scene, hits: Hits, directions: FloatArray) -> FloatArray:
    cos = np.abs(np.einsum("ij,ij->i", scene.normals[hits.quad], directions)) / np.linalg.norm(directions, axis=1)
    return np.where(hits.quad >= 0, cos, 1.0)


def _on_surface(scene: Scene, quads: np.ndarray, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places (s, t), (n,) each, metres along the edges of rectangles (n,)."""
    u, v = scene.edges_u_m[quads], scene.edges_v_m[quads]
    rel = points_m - scene.corners_m[quads]
    s = np.einsum("ij,ij->i", rel, u) / np.linalg.norm(u, axis=1)
    t = np.einsum("ij,ij->i", rel, v) / np.linalg.norm(v, axis=1)
    return s, t


def _patches(scene: Scene, quads: np.ndarray, points_m: FloatArray) -> np.ndarray:
    """Numbers (n,) of the patches of one colour that points (n, 3) lie on."""
    s, t = _on_surface(scene, quads, points_m)
    patch = quads * 10_000
    for m, material in enumerate(scene.materials):
        mine = scene.material[quads] == m
        patch[mine] += textures.cells(material, s[mine], t[mine])
    return patch


def _radiance(
    scene: Scene,
    quads: np.ndarray,
    points_m: FloatArray,
    eye_m: FloatArray,
    shadow_caster: Caster | None,
    spread: FloatArray | None,
) -> FloatArray:
    """Linear RGB (n, 3) of matt points (n, 3) on rectangles (n,).

    With `shadow_caster`, `spread` (1 + lights, n, 2) in [0, 1) chooses a direction into the room and a place on each
    light for each point; without, nothing throws shadows.
    """
    s, t = _on_surface(scene, quads, points_m)
    kind = scene.material[quads]
    color = np.empty((len(quads), 3))
    glows = np.zeros(len(quads), bool)
    for m in np.unique(kind):
        mine = np.flatnonzero(kind == m)
        color[mine] = textures.albedo(scene.materials[m], s[mine], t[mine], quads[mine].astype(float))
        glows[mine] = scene.materials[m].kind == "glow"
    normals = scene.normals[quads]
    normals = normals * np.sign(np.einsum("ij,ij->i", normals, eye_m - points_m))[:, None]
    lifted = points_m + 2e-3 * normals
    ambient = _AMBIENT * (0.75 + 0.25 * normals[:, 2:])
    if shadow_caster is None or spread is None:
        light = ambient
        for lamp in LIGHTS:
            for place in _LAMP_PLACES:
                light = light + _from_lamp(lamp, place, lifted, normals)[0][:, None] * lamp.power / len(_LAMP_PLACES)
    else:
        light = ambient * _openness(lifted, normals, shadow_caster, spread[0])[:, None]
        for lamp, places in zip(LIGHTS, spread[1:], strict=True):
            share, to_lamp = _from_lamp(lamp, places, lifted, normals)
            lit = np.flatnonzero(share > 0)
            share[lit[shadow_caster.blocked(lifted[lit], to_lamp[lit], 0.98)]] = 0
            light = light + share[:, None] * lamp.power
    return np.where(glows[:, None], color, color * light)


def _from_lamp(
    lamp: Light, places: FloatArray, points_m: FloatArray, normals: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Irradiance (n,) for a power of one from `places` (n or 1, 2) on a light, and the way there (n, 3), metres."""
    to_lamp = lamp.corner_m + places[:, :1] * lamp.u_m + places[:, 1:] * lamp.v_m - points_m
    r2 = np.einsum("ij,ij->i", to_lamp, to_lamp)
    cosines = np.maximum(np.einsum("ij,ij->i", to_lamp, normals), 0) * np.maximum(-to_lamp @ lamp.normal, 0)
    return cosines / (r2 * np.maximum(r2, 0.3)), to_lamp


def _openness(lifted_m: FloatArray, normals: FloatArray, caster: Caster, spread: FloatArray) -> FloatArray:
    """Share (n,) of the light from all around that is not taken away by things near by: one ray for each point."""
    # a direction on the sphere, added to the normal: density by the cosine
    z, turn = 2 * spread[:, 0] - 1, 2 * np.pi * spread[:, 1]
    r = np.sqrt(1 - z * z)
    direction = normals * 1.001 + np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.where(caster.blocked(lifted_m, direction, _BOUNCE_FAR_M), 0.25, 1.0)

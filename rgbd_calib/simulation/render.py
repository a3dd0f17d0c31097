"""Colour images by supersampled ray casting through the full lens model.

A pixel is the mean of the light over its square: rays are spread evenly over it, by geometry.camera.rays, so that
edges are where the projection puts them. Only pixels that an edge of the board crosses get many rays; the room does
not move, so each camera's picture of it is made once. What the camera makes of the light is :mod:`.color_sensor`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation import textures
from rgbd_calib.simulation.bent import BentFace
from rgbd_calib.simulation.scene import Caster, Hits, Scene

ROOM_SAMPLES = 8
"""Rays for a pixel of the room on one surface."""
EDGE_SAMPLES = 12
"""Rays for a pixel that an outline crosses."""
PRINT_SAMPLES = 48
"""Places in a pixel that an edge of the board's print crosses: its corners are what is measured."""
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


@dataclass(frozen=True)
class Picture:
    """What an ideal camera sees: no blur, no noise."""

    light: np.ndarray
    """(h, w, 3) linear RGB, float32."""
    z_m: FloatArray
    """(h, w) depth along the optical axis at the middles of the pixels, inf where nothing is."""
    cos_incidence: FloatArray
    """(h, w) between ray and surface."""


def render_room(view: View, caster: Caster, rng: np.random.Generator) -> Picture:
    """The room as one camera sees it, with soft shadows."""
    h, w = view.shape
    hits = caster.cast(view.origin_m, view.centres)
    crossed = _crossed(hits.quad.reshape(h, w))
    light = np.empty((h * w, 3), np.float32)
    for some, samples in ((np.flatnonzero(~crossed), ROOM_SAMPLES), (np.flatnonzero(crossed), EDGE_SAMPLES)):
        light[some] = _supersample(view, some, [caster], caster, rng, samples)
    cos = _cos_incidence(caster.scene, hits, view.centres)
    return Picture(light.reshape(h, w, 3), hits.t.reshape(h, w), cos.reshape(h, w))


def render_with_board(
    view: View,
    room: Picture,
    room_caster: Caster,
    board_caster: Caster,
    rng: np.random.Generator,
    bent: Mapping[int, BentFace] | None = None,
) -> Picture:
    """The room's picture with the board (and its stand) put in front of it; `bent` are its faces as this camera sees them,
    by their rectangle, None: flat and printed as they should be."""
    h, w = view.shape
    scene, bent = board_caster.scene, bent or {}
    seen = see_board(view, room.z_m, board_caster, bent)
    shown, quads = seen.pixels, seen.quads
    quad = np.full(h * w, -1)
    quad[shown] = quads
    patch = np.full(h * w, -1)
    patch[shown] = _patches(scene, quads, seen.s_m, seen.t_m)
    outline, crossed = _crossed(quad.reshape(h, w)), _crossed(patch.reshape(h, w))

    light = room.light.reshape(-1, 3).copy()
    plain = ~outline[shown]
    points = view.origin_m + seen.z_m[plain, None] * view.centres[shown[plain]]
    irradiance = _irradiance(_facing(scene.normals[quads[plain]], points, view.origin_m), points)
    color = _albedo(scene, quads[plain], seen.s_m[plain], seen.t_m[plain])[0]
    mixed = np.flatnonzero(crossed[shown[plain]])
    color[mixed] = _mean_albedo(view, scene, quads[plain][mixed], shown[plain][mixed], bent, rng)
    light[shown[plain]] = color * irradiance
    edges = np.flatnonzero(outline)
    light[edges] = _supersample(view, edges, [board_caster, room_caster], room_caster, rng, EDGE_SAMPLES)
    return Picture(light.reshape(h, w, 3), *with_board(room.z_m, room.cos_incidence, seen))


@dataclass(frozen=True)
class SeenBoard:
    """Pixels in which a camera sees the board or its stand, in front of the room."""

    pixels: np.ndarray
    """(n,) row-major numbers."""
    quads: np.ndarray
    """(n,) rectangles."""
    z_m: FloatArray
    """(n,)."""
    s_m: FloatArray
    """(n,): place on the rectangle, on a bent face on its page."""
    t_m: FloatArray
    cos_incidence: FloatArray
    """(n,)."""


def see_room(view: View, caster: Caster) -> tuple[FloatArray, FloatArray]:
    """Depth and cosine of incidence, (h, w) each, of the room alone."""
    hits = caster.cast(view.origin_m, view.centres)
    return hits.t.reshape(view.shape), _cos_incidence(caster.scene, hits, view.centres).reshape(view.shape)


def see_board(view: View, room_z_m: FloatArray, board_caster: Caster, bent: Mapping[int, BentFace]) -> SeenBoard:
    """The board before a room of depths (h, w)."""
    scene = board_caster.scene
    near = view.around(scene)
    hits = board_caster.cast(view.origin_m, view.centres[near])
    front = hits.t < room_z_m.ravel()[near]
    pixels, quads, z_m = near[front], hits.quad[front], hits.t[front]
    rays = view.centres[pixels]
    s_m, t_m = _on_surface(scene, quads, view.origin_m + z_m[:, None] * rays)
    for number, face in bent.items():
        mine = np.flatnonzero(quads == number)
        s_m[mine], t_m[mine], stretch = face.meet(s_m[mine], t_m[mine])
        z_m[mine] *= stretch
    return SeenBoard(pixels, quads, z_m, s_m, t_m, _cos_incidence(scene, Hits(quads, z_m), rays))


def with_board(room_z_m: FloatArray, room_cos: FloatArray, seen: SeenBoard) -> tuple[FloatArray, FloatArray]:
    """Depth and cosine of incidence, (h, w) each, of the room with the board before it."""
    z_m, cos = room_z_m.copy(), room_cos.copy()
    z_m.reshape(-1)[seen.pixels] = seen.z_m
    cos.reshape(-1)[seen.pixels] = seen.cos_incidence
    return z_m, cos


def _crossed(numbers: np.ndarray) -> np.ndarray:
    """(h * w,) bool: is any of a pixel's eight neighbours of another number? Numbers (h, w), below 2^24."""
    image = numbers.astype(np.float32)
    square = np.ones((3, 3), np.uint8)
    flat: np.ndarray = (cv2.dilate(image, square) != cv2.erode(image, square)).ravel()
    return flat


def _supersample(
    view: View,
    pixels: np.ndarray,
    casters: list[Caster],
    room_caster: Caster,
    rng: np.random.Generator,
    samples: int,
) -> FloatArray:
    """Mean light (n, 3) over the squares of pixels (n,), row-major numbers; the nearest hit of the casters counts.
    Only what `room_caster` hits lies in shadows, those of the room."""
    mean = np.empty((len(pixels), 3))
    step = max(1, _CHUNK_RAYS // samples)
    for first in range(0, len(pixels), step):
        some = pixels[first : first + step]
        directions = view.through(some, _spread(len(some), samples, rng) - 0.5).reshape(-1, 3)
        spread = [_spread(len(some), samples, rng).reshape(-1, 2) for _ in range(1 + len(LIGHTS))]
        hits = [caster.cast(view.origin_m, directions) for caster in casters]
        nearest = np.argmin([h.t for h in hits], axis=0)
        light = np.zeros((len(directions), 3))
        for i, caster in enumerate(casters):
            mine = np.flatnonzero((nearest == i) & (hits[i].quad >= 0))
            quads = hits[i].quad[mine]
            points = view.origin_m + hits[i].t[mine, None] * directions[mine]
            color, glows = _albedo(caster.scene, quads, *_on_surface(caster.scene, quads, points))
            normals = _facing(caster.scene.normals[quads], points, view.origin_m)
            if caster is room_caster:
                irradiance = _shadowed_irradiance(normals, points, caster, [a[mine] for a in spread])
            else:
                irradiance = _irradiance(normals, points)
            irradiance[glows] = 1.0
            light[mine] = color * irradiance
        mean[first : first + step] = light.reshape(len(some), samples, 3).mean(axis=1)
    return mean


def _mean_albedo(
    view: View,
    scene: Scene,
    quads: np.ndarray,
    pixels: np.ndarray,
    bent: Mapping[int, BentFace],
    rng: np.random.Generator,
) -> FloatArray:
    """Mean albedo (n, 3) of pixels (n,) that see nothing but rectangles (n,), across the edges of their print."""
    mean = np.empty((len(pixels), 3))
    for q in np.unique(quads):
        mine = np.flatnonzero(quads == q)
        offsets = _spread(len(mine), PRINT_SAMPLES, rng) - 0.5
        rel = scene.corners_m[q] - view.origin_m
        normal, places = scene.normals[q], []
        for edge in (scene.edges_u_m[q], scene.edges_v_m[q]):
            axis = edge / np.linalg.norm(edge)
            places.append(view.on_plane(pixels[mine], offsets, normal, float(normal @ rel), axis) - axis @ rel)
        if q in bent:
            places[:] = bent[q].meet(*places)[:2]
        material = scene.materials[scene.material[q]]
        mean[mine] = textures.print_mean(material, textures.ink(material, *places).mean(axis=1))
    return mean


def _spread(n: int, samples: int, rng: np.random.Generator) -> FloatArray:
    """Places (n, samples, 2) spread evenly over the unit square (R2 sequence, M. Roberts 2018), shifted at random
    for each pixel, so that the mean over many pixels has no bias."""
    golden = np.array([0.7548776662466927, 0.5698402909980532])
    places: FloatArray = (np.arange(1, samples + 1)[:, None] * golden) % 1.0 + rng.random((n, 1, 2))
    places -= places >= 1.0
    return places


def _cos_incidence(scene: Scene, hits: Hits, directions: FloatArray) -> FloatArray:
    cos = np.abs(np.einsum("ij,ij->i", scene.normals[hits.quad], directions)) / np.linalg.norm(directions, axis=1)
    return np.where(hits.quad >= 0, cos, 1.0)


def _on_surface(scene: Scene, quads: np.ndarray, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places (s, t), (n,) each, metres along the edges of rectangles (n,)."""
    u = scene.edges_u_m / np.linalg.norm(scene.edges_u_m, axis=1, keepdims=True)
    v = scene.edges_v_m / np.linalg.norm(scene.edges_v_m, axis=1, keepdims=True)
    rel = points_m - scene.corners_m[quads]
    return np.einsum("ij,ij->i", rel, u[quads]), np.einsum("ij,ij->i", rel, v[quads])


def _patches(scene: Scene, quads: np.ndarray, s_m: FloatArray, t_m: FloatArray) -> np.ndarray:
    """Numbers (n,) of the patches of one colour at places on rectangles (n,)."""
    patch = quads * 10_000
    for m, material in enumerate(scene.materials):
        mine = scene.material[quads] == m
        patch[mine] += textures.cells(material, s_m[mine], t_m[mine])
    return patch


def _albedo(scene: Scene, quads: np.ndarray, s_m: FloatArray, t_m: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Linear colour (n, 3) at places on rectangles (n,), and whether they shine by themselves (n,)."""
    kind = scene.material[quads]
    color = np.empty((len(quads), 3))
    glows = np.zeros(len(quads), bool)
    for m in np.flatnonzero(np.bincount(kind, minlength=len(scene.materials))):
        mine = np.flatnonzero(kind == m)
        material = scene.materials[m]
        color[mine] = textures.albedo(material, s_m[mine], t_m[mine], quads[mine].astype(float))
        glows[mine] = material.kind == "glow"
    return color, glows


def _facing(normals: FloatArray, points_m: FloatArray, eye_m: FloatArray) -> FloatArray:
    """Normals (n, 3), turned towards the eye (3,)."""
    away = np.einsum("ij,ij->i", normals, points_m - eye_m) > 0
    return np.where(away[:, None], -normals, normals)


def _irradiance(normals: FloatArray, points_m: FloatArray) -> FloatArray:
    """Light (n, 3) on points (n, 3) where nothing throws shadows."""
    light = _AMBIENT * (0.75 + 0.25 * normals[:, 2:])
    for lamp in LIGHTS:
        light += _from_lamp(lamp, np.array([[0.5, 0.5]]), points_m, normals)[0][:, None] * lamp.power
    return light


def _shadowed_irradiance(
    normals: FloatArray, points_m: FloatArray, caster: Caster, spread: list[FloatArray]
) -> FloatArray:
    """Light (n, 3) on points (n, 3); `spread`, 1 + lights arrays (n, 2) in [0, 1), chooses a direction into the room
    and a place on each light for each point."""
    lifted = points_m + 2e-3 * normals
    light = _AMBIENT * (0.75 + 0.25 * normals[:, 2:]) * _openness(lifted, normals, caster, spread[0])[:, None]
    for lamp, places in zip(LIGHTS, spread[1:], strict=True):
        share, to_lamp = _from_lamp(lamp, places, lifted, normals)
        lit = np.flatnonzero(share > 0)
        share[lit[caster.blocked(lifted[lit], to_lamp[lit], 0.98)]] = 0
        light += share[:, None] * lamp.power
    return light


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

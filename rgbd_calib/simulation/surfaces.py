"""The surface that each pixel sees: which, where on it, and its colour."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation import textures
from rgbd_calib.simulation.bent import BentFace
from rgbd_calib.simulation.scene import Caster, Hits, Scene
from rgbd_calib.simulation.view import View

PRINT_SAMPLES = 48
"""Places in a pixel that an edge of the board's print crosses: its corners are what is measured."""


_CELLS = 200_000
"""More than a print has: of 40 x 40 corners, with markers of 8 x 8 cells, 170,000."""


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
    return hits.t.reshape(view.shape), cos_incidence(caster.scene, hits, view.centres).reshape(view.shape)


def see_board(view: View, room_z_m: FloatArray, board_caster: Caster, bent: Mapping[int, BentFace]) -> SeenBoard:
    """The board before a room of depths (h, w)."""
    scene = board_caster.scene
    near = view.around(scene)
    hits = board_caster.cast(view.origin_m, view.centres[near])
    front = hits.t < room_z_m.ravel()[near]
    pixels, quads, z_m = near[front], hits.quad[front], hits.t[front]
    rays = view.centres[pixels]
    s_m, t_m = on_surface(scene, quads, view.origin_m + z_m[:, None] * rays)
    for number, face in bent.items():
        mine = np.flatnonzero(quads == number)
        s_m[mine], t_m[mine], stretch = face.meet(s_m[mine], t_m[mine])
        z_m[mine] *= stretch
    return SeenBoard(pixels, quads, z_m, s_m, t_m, cos_incidence(scene, Hits(quads, z_m), rays))


def with_board(room_z_m: FloatArray, room_cos: FloatArray, seen: SeenBoard) -> tuple[FloatArray, FloatArray]:
    """Depth and cosine of incidence, (h, w) each, of the room with the board before it."""
    z_m, cos = room_z_m.copy(), room_cos.copy()
    z_m.reshape(-1)[seen.pixels] = seen.z_m
    cos.reshape(-1)[seen.pixels] = seen.cos_incidence
    return z_m, cos


def edge_pixels(numbers: np.ndarray) -> np.ndarray:
    """(h * w,) bool: is any of a pixel's eight neighbours of another number? Numbers (h, w), below 2^24."""
    image = numbers.astype(np.float32)
    square = np.ones((3, 3), np.uint8)
    flat: np.ndarray = (cv2.dilate(image, square) != cv2.erode(image, square)).ravel()
    return flat


def board_albedo(
    view: View,
    scene: Scene,
    seen: SeenBoard,
    which: np.ndarray,
    bent: Mapping[int, BentFace],
    rng: np.random.Generator,
) -> FloatArray:
    """Linear colour (m, 3) of the pixels `which` (m,), indices into `seen`: averaged over the pixel where an edge of the print
    crosses it."""
    patch = np.full(view.shape[0] * view.shape[1], -1)
    patch[seen.pixels] = patches(scene, seen.quads, seen.s_m, seen.t_m)
    crossed = edge_pixels(patch.reshape(view.shape))
    quads, pixels = seen.quads[which], seen.pixels[which]
    color = albedo(scene, quads, seen.s_m[which], seen.t_m[which])[0]
    printed = np.array([material.board is not None for material in scene.materials])[scene.material[quads]]
    mixed = np.flatnonzero(crossed[pixels] & printed)
    color[mixed] = mean_albedo(view, scene, quads[mixed], pixels[mixed], bent, rng)
    return color


def mean_albedo(
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
        offsets = spread_places(len(mine), PRINT_SAMPLES, rng) - 0.5
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


def spread_places(n: int, samples: int, rng: np.random.Generator) -> FloatArray:
    """Places (n, samples, 2) spread evenly over the unit square (R2 sequence, M. Roberts 2018), shifted at random
    for each pixel, so that the mean over many pixels has no bias."""
    golden = np.array([0.7548776662466927, 0.5698402909980532])
    places: FloatArray = (np.arange(1, samples + 1)[:, None] * golden) % 1.0 + rng.random((n, 1, 2))
    places -= places >= 1.0
    return places


def cos_incidence(scene: Scene, hits: Hits, directions: FloatArray) -> FloatArray:
    cos = np.abs(np.einsum("ij,ij->i", scene.normals[hits.quad], directions)) / np.linalg.norm(directions, axis=1)
    return np.where(hits.quad >= 0, cos, 1.0)


def on_surface(scene: Scene, quads: np.ndarray, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places (s, t), (n,) each, metres along the edges of rectangles (n,)."""
    u = scene.edges_u_m / np.linalg.norm(scene.edges_u_m, axis=1, keepdims=True)
    v = scene.edges_v_m / np.linalg.norm(scene.edges_v_m, axis=1, keepdims=True)
    rel = points_m - scene.corners_m[quads]
    return np.einsum("ij,ij->i", rel, u[quads]), np.einsum("ij,ij->i", rel, v[quads])


def patches(scene: Scene, quads: np.ndarray, s_m: FloatArray, t_m: FloatArray) -> np.ndarray:
    """Numbers (n,) of the patches of one colour at places on rectangles (n,)."""
    patch = quads * _CELLS
    for m, material in enumerate(scene.materials):
        mine = scene.material[quads] == m
        patch[mine] += textures.cells(material, s_m[mine], t_m[mine])
    return patch


def albedo(scene: Scene, quads: np.ndarray, s_m: FloatArray, t_m: FloatArray) -> tuple[FloatArray, np.ndarray]:
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


def facing(normals: FloatArray, points_m: FloatArray, eye_m: FloatArray) -> FloatArray:
    """Normals (n, 3), turned towards the eye (3,)."""
    away = np.einsum("ij,ij->i", normals, points_m - eye_m) > 0
    return np.where(away[:, None], -normals, normals)

"""Colour images by supersampled ray casting through the full lens model.

A pixel is the mean of the light over its square: rays are spread evenly over it, by geometry.camera.rays, so that
edges are where the projection puts them. Only pixels that an edge of the board crosses get many rays; the room does
not move, so each camera's picture of it is made once. What the camera makes of the light is :mod:`.color_sensor`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.bent import BentFace
from rgbd_calib.simulation.lighting import LIGHTS, shadowed_irradiance, unshadowed
from rgbd_calib.simulation.scene import Caster
from rgbd_calib.simulation.surfaces import (
    albedo,
    board_albedo,
    cos_incidence,
    edge_pixels,
    facing,
    on_surface,
    see_board,
    spread_places,
    with_board,
)
from rgbd_calib.simulation.view import View

ROOM_SAMPLES = 8
"""Rays for a pixel of the room on one surface."""
EDGE_SAMPLES = 12
"""Rays for a pixel that an outline crosses."""
_CHUNK_RAYS = 400_000


@dataclass(frozen=True)
class IdealImage:
    """What an ideal camera sees: no blur, no noise."""

    light: np.ndarray
    """(h, w, 3) linear RGB, float32."""
    z_m: FloatArray
    """(h, w) depth along the optical axis at the middles of the pixels, inf where nothing is."""
    cos_incidence: FloatArray
    """(h, w) between ray and surface."""


def render_room(view: View, caster: Caster, rng: np.random.Generator) -> IdealImage:
    """The room as one camera sees it, with soft shadows."""
    h, w = view.shape
    hits = caster.cast(view.origin_m, view.centres)
    crossed = edge_pixels(hits.quad.reshape(h, w))
    light = np.empty((h * w, 3), np.float32)
    for some, samples in ((np.flatnonzero(~crossed), ROOM_SAMPLES), (np.flatnonzero(crossed), EDGE_SAMPLES)):
        light[some] = _supersample(view, some, [caster], caster, rng, samples)
    cos = cos_incidence(caster.scene, hits, view.centres)
    return IdealImage(light.reshape(h, w, 3), hits.t.reshape(h, w), cos.reshape(h, w))


def render_with_board(
    view: View,
    room: IdealImage,
    room_caster: Caster,
    board_caster: Caster,
    rng: np.random.Generator,
    bent: Mapping[int, BentFace] | None = None,
) -> IdealImage:
    """The room's picture with the board (and its stand) put in front of it; `bent` are its faces as this camera sees them,
    by their rectangle, None: flat and printed as they should be."""
    h, w = view.shape
    scene, bent = board_caster.scene, bent or {}
    seen = see_board(view, room.z_m, board_caster, bent)
    quad = np.full(h * w, -1)
    quad[seen.pixels] = seen.quads
    outline = edge_pixels(quad.reshape(h, w))

    light = room.light.reshape(-1, 3).copy()
    plain = np.flatnonzero(~outline[seen.pixels])
    pixels = seen.pixels[plain]
    points = view.origin_m + seen.z_m[plain, None] * view.centres[pixels]
    irradiance = unshadowed(facing(scene.normals[seen.quads[plain]], points, view.origin_m), points)
    light[pixels] = board_albedo(view, scene, seen, plain, bent, rng) * irradiance
    edges = np.flatnonzero(outline)
    light[edges] = _supersample(view, edges, [board_caster, room_caster], room_caster, rng, EDGE_SAMPLES)
    return IdealImage(light.reshape(h, w, 3), *with_board(room.z_m, room.cos_incidence, seen))


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
        directions = view.through(some, spread_places(len(some), samples, rng) - 0.5).reshape(-1, 3)
        spread = [spread_places(len(some), samples, rng).reshape(-1, 2) for _ in range(1 + len(LIGHTS))]
        hits = [caster.cast(view.origin_m, directions) for caster in casters]
        nearest = np.argmin([h.t for h in hits], axis=0)
        light = np.zeros((len(directions), 3))
        for i, caster in enumerate(casters):
            mine = np.flatnonzero((nearest == i) & (hits[i].quad >= 0))
            quads = hits[i].quad[mine]
            points = view.origin_m + hits[i].t[mine, None] * directions[mine]
            color, glows = albedo(caster.scene, quads, *on_surface(caster.scene, quads, points))
            normals = facing(caster.scene.normals[quads], points, view.origin_m)
            if caster is room_caster:
                irradiance = shadowed_irradiance(normals, points, caster, [a[mine] for a in spread])
            else:
                irradiance = unshadowed(normals, points)
            irradiance[glows] = 1.0
            light[mine] = color * irradiance
        mean[first : first + step] = light.reshape(len(some), samples, 3).mean(axis=1)
    return mean

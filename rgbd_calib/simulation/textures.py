"""Procedural textures: linear albedo in [0, 1] as a function of a place in metres on a surface."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.patterns.black import lattice
from rgbd_calib.types import Board

RGB = tuple[float, float, float]

_TILE = 512
"""Side of the noise tile in samples; it repeats."""


@dataclass(frozen=True)
class Material:
    """A surface: its kind of texture, colours (sRGB, 0-1) and the length in metres that the texture is built on."""

    name: str
    kind: str
    colors: tuple[RGB, ...]
    size_m: float = 0.1
    board: Board | None = None
    """Of a print: what is printed; its corner (0, 0) is `size_m` from both edges."""


def hex_color(code: str) -> RGB:
    """sRGB (0-1) of a code such as "c8a27a"."""
    r, g, b = (int(code[i : i + 2], 16) / 255 for i in (0, 2, 4))
    return r, g, b


def plain(name: str, code: str) -> Material:
    """A painted surface with faint brush marks."""
    return Material(name, "plain", (hex_color(code),))


def linear(srgb: FloatArray) -> FloatArray:
    """Linear light of sRGB values (IEC 61966-2-1), both 0-1."""
    srgb = np.asarray(srgb, float)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def encode(light: FloatArray) -> FloatArray:
    """sRGB of linear light, both 0-1; the inverse of :func:`linear`."""
    light = np.clip(light, 0.0, 1.0)
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * np.power(light, 1 / 2.4) - 0.055)


def cells(material: Material, s_m: FloatArray, t_m: FloatArray) -> np.ndarray:
    """Number of the patch of one colour at (s, t), (n,): where it changes, a sharp edge runs between."""
    if material.board is None:
        return np.zeros(len(s_m), int)
    print_ = lattice(material.board)
    i, j = print_.cells(s_m - material.size_m, t_m - material.size_m)
    across, down = np.array(print_.black.shape) - 1
    inside = (i > 0) & (i < across) & (j > 0) & (j < down)
    return np.where(inside, i * down + j, 0)


def albedo(material: Material, s_m: FloatArray, t_m: FloatArray, salt: FloatArray) -> FloatArray:
    """Linear albedo (n, 3) at places (s, t), metres; `salt` (n,) differs from surface to surface."""
    return _KINDS[material.kind](material, s_m, t_m, salt)


def _mix(a: RGB, b: RGB, weight: FloatArray) -> FloatArray:
    return linear(np.array(a)) * (1 - weight[:, None]) + linear(np.array(b)) * weight[:, None]


@lru_cache(maxsize=1)
def _noise_tile() -> np.ndarray:
    rng = np.random.default_rng(20)
    total = np.zeros((_TILE, _TILE))
    for sigma in (1.0, 2.0, 4.0, 8.0, 16.0):
        white = np.pad(rng.standard_normal((_TILE, _TILE)), 64, mode="wrap")
        layer = cv2.GaussianBlur(white, (0, 0), sigma)[64:-64, 64:-64]
        total += layer / layer.std() * np.sqrt(sigma)
    return (total / total.std()).astype(np.float32)


def noise(x: FloatArray, y: FloatArray) -> FloatArray:
    """Smooth noise (n,) of unit deviation at coordinates (n,) in samples of the tile."""
    tile = _noise_tile()
    x0, y0 = np.floor(x), np.floor(y)
    a, b = (x - x0).astype(np.float32), (y - y0).astype(np.float32)
    i, j = x0.astype(np.int64) % _TILE, y0.astype(np.int64) % _TILE
    i1, j1 = (i + 1) % _TILE, (j + 1) % _TILE
    top = tile[j, i] * (1 - a) + tile[j, i1] * a
    bottom = tile[j1, i] * (1 - a) + tile[j1, i1] * a
    return (top * (1 - b) + bottom * b).astype(float)


def _hash(*keys: FloatArray) -> FloatArray:
    """Uniform numbers (n,) in [0, 1) that depend on whole-numbered keys (n,)."""
    h = np.zeros(np.broadcast(*keys).shape, np.uint64)
    with np.errstate(over="ignore"):
        for key in keys:
            h = (h ^ np.asarray(key).astype(np.int64).astype(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
            h ^= h >> np.uint64(29)
    return (h >> np.uint64(40)).astype(float) / 2**24


def _plain(m: Material, s: FloatArray, t: FloatArray, salt: FloatArray) -> FloatArray:
    shade = 1 + 0.02 * noise(s * 200 + 37 * salt, t * 200)
    return linear(np.array(m.colors[0])) * shade[:, None]


def _planks(m: Material, s: FloatArray, t: FloatArray, salt: FloatArray) -> FloatArray:
    """Boards of width `size_m` along s, 8 times as long, joints dark."""
    row = np.floor(t / m.size_m)
    along = s / (8 * m.size_m) + _hash(row, salt)
    column = np.floor(along)
    tone = _hash(row, column, salt)
    grain = noise(s * 25 + 91 * tone * _TILE, t * 500 + 53 * tone * _TILE)
    color = _mix(m.colors[0], m.colors[1], np.clip(0.15 + 0.6 * tone + 0.14 * grain, 0, 1))
    to_joint = np.minimum(
        np.abs(t / m.size_m - row - 0.5) * -1 + 0.5, (0.5 - np.abs(along - column - 0.5)) * 8
    )  # in widths
    return color * (1 - 0.55 * np.exp(-((to_joint / 0.02) ** 2)))[:, None]


def _wood(m: Material, s: FloatArray, t: FloatArray, salt: FloatArray) -> FloatArray:
    grain = noise(s * 18 + 61 * salt, t * 260 + 17 * salt) + 0.4 * noise(s * 60, t * 900 + 29 * salt)
    return _mix(m.colors[0], m.colors[1], np.clip(0.5 + 0.25 * grain, 0, 1))


def _fabric(m: Material, s: FloatArray, t: FloatArray, salt: FloatArray) -> FloatArray:
    weave = noise(s * 900 + 31 * salt, t * 250) + noise(s * 250, t * 900 + 31 * salt)
    return linear(np.array(m.colors[0])) * np.clip(1 + 0.10 * weave + 0.05 * noise(s * 40, t * 40), 0.3, 2)[:, None]


def _rug(m: Material, s: FloatArray, t: FloatArray, salt: FloatArray) -> FloatArray:
    """Diamonds of `size_m` in two colours, with a third in the middle of each."""
    a, b = (s + t) / m.size_m, (s - t) / m.size_m
    middle = np.maximum(np.abs(a % 1 - 0.5), np.abs(b % 1 - 0.5))
    color = _mix(m.colors[0], m.colors[1], ((np.floor(a) + np.floor(b)) % 2).astype(float))
    color = np.where((middle < 0.22)[:, None], linear(np.array(m.colors[2])), color)
    return color * np.clip(1 + 0.13 * noise(s * 700, t * 700), 0.4, 2)[:, None]


def _brick(m: Material, s: FloatArray, t: FloatArray, salt: FloatArray) -> FloatArray:
    """Bricks of height `size_m`, three times as long, each in its own tone; the last colour is the mortar."""
    row = np.floor(t / m.size_m)
    along = s / (3 * m.size_m) + 0.5 * (row % 2)
    column = np.floor(along)
    edge = np.minimum(0.5 - np.abs(t / m.size_m - row - 0.5), 3 * (0.5 - np.abs(along - column - 0.5)))
    rough = noise(s * 300, t * 300)
    color = _mix(m.colors[0], m.colors[1], np.clip(_hash(row, column) + 0.12 * rough, 0, 1))
    mortar = linear(np.array(m.colors[2])) * (1 + 0.05 * rough)[:, None]
    weight = np.clip((edge - 0.05 + 0.02 * rough) / 0.04, 0, 1)[:, None]
    return color * weight + mortar * (1 - weight)


def _picture(m: Material, s: FloatArray, t: FloatArray, salt: FloatArray) -> FloatArray:
    """An abstract landscape: bands that roll, and a sun; heights in units of `size_m`, the picture's height."""
    x, y = s / m.size_m, 1 - t / m.size_m
    color = _mix(m.colors[0], m.colors[1], np.clip(y * 1.3, 0, 1))
    sun = (x - 1.0) ** 2 + (y - 0.35) ** 2 < 0.02
    color[sun] = linear(np.array(m.colors[-1]))
    for k, c in enumerate(m.colors[2:-1]):
        ridge = 0.42 + 0.16 * k + 0.09 * np.sin(x * (5 - k) + 2.1 * k) + 0.03 * noise(x * 40 + 100 * k, 0 * y)
        color[y > ridge] = linear(np.array(c))
    return color * (1 + 0.03 * noise(s * 400, t * 400))[:, None]


def _glow(m: Material, s: FloatArray, t: FloatArray, salt: FloatArray) -> FloatArray:
    return np.broadcast_to(linear(np.array(m.colors[0])), (len(s), 3)).copy()


def ink(m: Material, s_m: FloatArray, t_m: FloatArray) -> np.ndarray:
    """Is a print black at (s, t), any shape?"""
    assert m.board is not None
    return lattice(m.board).is_black(s_m - m.size_m, t_m - m.size_m)


def print_mean(m: Material, dark: FloatArray) -> FloatArray:
    """Linear albedo (n, 3) of a print where a share `dark` (n,) of it is black."""
    return _mix(m.colors[1], m.colors[0], dark)


def _print(m: Material, s: FloatArray, t: FloatArray, salt: FloatArray) -> FloatArray:
    """colours[0] is the ink's, colours[1] the paper's."""
    return print_mean(m, ink(m, s, t).astype(float))


_KINDS = {
    "plain": _plain,
    "planks": _planks,
    "wood": _wood,
    "fabric": _fabric,
    "rug": _rug,
    "brick": _brick,
    "picture": _picture,
    "glow": _glow,
    "print": _print,
}

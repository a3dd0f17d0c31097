"""A furnished room, 6.8 x 6.0 x 2.7 m. Frame: x to the right, y to the back wall, z up, origin on the floor."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from rgbd_calib.simulation.scene import Scene, box, cone, join, quad, rod
from rgbd_calib.simulation.textures import Material, hex_color, plain

ROOM_LOW_M = np.array([-3.4, -3.0, 0.0])
ROOM_HIGH_M = np.array([3.4, 3.0, 2.7])


def _colored(name: str, kind: str, size_m: float, *codes: str) -> Material:
    return Material(name, kind, tuple(hex_color(c) for c in codes), size_m)


FLOOR = _colored("floor", "planks", 0.13, "b98d5f", "8a6036")
RUG = _colored("rug", "rug", 0.36, "8c2f2b", "2c3e5c", "d9c7a0")
WALL = plain("wall", "ddd6c6")
ACCENT = plain("blue wall", "8fa6ad")
BRICK = _colored("brick wall", "brick", 0.075, "a05a42", "7c3f30", "b9b0a2")
CEILING = plain("ceiling", "f2f0ea")
TRIM = plain("skirting", "f0ece2")
OAK = _colored("oak", "wood", 0.1, "c59a64", "9b6f3f")
WALNUT = _colored("walnut", "wood", 0.1, "7a5234", "51341f")
SOFA = _colored("sofa", "fabric", 0.1, "5d7f78")
CUSHION = _colored("cushion", "fabric", 0.1, "d9a441")
CUSHION_2 = _colored("cushion 2", "fabric", 0.1, "b8553c")
SEAT = _colored("chair", "fabric", 0.1, "c4573f")
BLACK = plain("black metal", "2b2b2e")
POT = plain("pot", "c9785a")
LEAF = plain("leaf", "4f7d3c")
LEAF_2 = plain("leaf 2", "6b9a4b")
CERAMIC = plain("ceramic", "e9e4d8")
LAMP = Material("lamp", "glow", (hex_color("fff6e2"),))
SKY = Material("window", "glow", (hex_color("e8f2ff"),))
BOOKS = tuple(
    plain(f"book {i}", c)
    for i, c in enumerate(("8b2e2e", "2f4f6f", "d8b365", "3f6b4f", "e6dfcf", "5b3a5e", "c46f3b", "27323f", "7d9ba6"))
)


def furniture() -> tuple[Scene, ...]:
    """Everything that stands in the room, piece by piece; the middle is free for the board."""
    return (
        _table(1.75, 1.35, 1.3, 0.8, 0.74),
        _chair(1.45, 0.62, 1),
        _chair(2.15, 0.55, 1),
        _chair(1.75, 2.1, -1),
        _sofa(-1.5, 2.45),
        _coffee_table(-1.35, 1.25),
        _shelf(2.45, 2.78),
        _sideboard(-3.15, -0.9),
        _plant(-3.0, 2.55),
        _floor_lamp(0.25, 2.6),
        _chair(2.5, -1.9, 1),
        _table(2.75, -2.45, 1.1, 0.6, 0.74),
        _plant(3.0, -0.6),
        _shelf(-2.2, -2.8),
    )


def furnished_room() -> Scene:
    """Walls, floor, ceiling and furniture."""
    return furnished_with(furniture())


def furnished_with(pieces: Iterable[Scene]) -> Scene:
    """Walls, floor and ceiling, and these things in it."""
    return join([_shell(), *pieces])


def _shell() -> Scene:
    low, high = ROOM_LOW_M, ROOM_HIGH_M
    x, y, z = np.diag(high - low)
    parts = [
        quad(low, x, y, FLOOR),
        quad(low + z, x, y, CEILING),
        quad(low + y, x, z, BRICK),
        quad(low, x, z, WALL),
        quad(low, y, z, ACCENT),
        quad(low + x, y, z, WALL),
        box([-1.55, -1.2, 0.0], [1.05, 0.75, 0.012], RUG),
        box([low[0], high[1] - 0.02, 0], [high[0], high[1], 0.09], TRIM),
        box([low[0], low[1], 0], [high[0], low[1] + 0.02, 0.09], TRIM),
        box([low[0], low[1], 0], [low[0] + 0.02, high[1], 0.09], TRIM),
        box([high[0] - 0.02, low[1], 0], [high[0], high[1], 0.09], TRIM),
        box([-1.0, -0.6, 2.66], [1.0, 0.6, 2.69], LAMP),
        _picture(
            [-2.3, 2.985, 1.35], [1, 0, 0], 1.1, 0.75, ("f3d9a6", "d97b4f", "7f8f9f", "4d6474", "2b3c4c", "fff2c4")
        ),
        _picture(
            [0.75, 2.985, 1.25], [1, 0, 0], 0.55, 0.75, ("cfe3e6", "9fc3c9", "5f8f86", "38615a", "1f3d3a", "f7d774")
        ),
        _picture(
            [0.6, -2.985, 1.25], [-1, 0, 0], 1.2, 0.8, ("e8c9b8", "b97a7a", "7d5a7a", "4c3f63", "2c2a44", "ffe9c9")
        ),
        _picture(
            [-3.385, -0.4, 1.3], [0, -1, 0], 0.9, 0.65, ("dfe8cf", "a9c08a", "6d8f5b", "46683f", "27432c", "f4e08a")
        ),
        _window(3.39, 0.15, 1.7, 0.95, 1.35),
        _door(3.39, -1.6),
    ]
    return join(parts)


def _picture(low: list[float], along: list[int], width: float, height: float, codes: tuple[str, ...]) -> Scene:
    """A framed picture: `low` is its lower left corner as seen, `along` its lower edge's direction."""
    corner, u, v = np.array(low), np.array(along, float), np.array([0.0, 0.0, 1.0])
    out = np.cross(u, v)
    paint = _colored(f"picture {codes[0]}", "picture", height, *codes)
    back, rim = 0.0, 0.035
    front = quad(corner + 0.012 * out, u * width, v * height, paint)
    bars = []
    for a, b in ((-rim, 0.0), (width, width + rim)):
        ends = np.stack([corner + a * u - rim * v + back * out, corner + b * u + (height + rim) * v + 0.02 * out])
        bars.append(box(ends.min(axis=0), ends.max(axis=0), WALNUT))
    for a, b in ((-rim, 0.0), (height, height + rim)):
        ends = np.stack([corner - rim * u + a * v + back * out, corner + (width + rim) * u + b * v + 0.02 * out])
        bars.append(box(ends.min(axis=0), ends.max(axis=0), WALNUT))
    return join([front, *bars])


def _window(x: float, y: float, width: float, z: float, height: float) -> Scene:
    pane = quad([x - 0.005, y, z], [0, width, 0], [0, 0, height], SKY)
    bar = 0.05
    bars = [box([x - 0.04, y + a - bar / 2, z], [x, y + a + bar / 2, z + height], TRIM) for a in (0, width / 2, width)]
    bars += [
        box([x - 0.04, y, z + a - bar / 2], [x, y + width, z + a + bar / 2], TRIM) for a in (0, height / 2, height)
    ]
    return join([pane, *bars, box([x - 0.16, y - 0.08, z - 0.07], [x, y + width + 0.08, z - 0.03], TRIM)])


def _door(x: float, y: float) -> Scene:
    panels = [
        box([x - 0.05, y + a, z], [x, y + a + 0.28, z + h], OAK)
        for a in (0.1, 0.5)
        for z, h in ((0.2, 0.7), (1.1, 0.75))
    ]
    knob = box([x - 0.1, y + 0.06, 1.0], [x - 0.03, y + 0.1, 1.04], BLACK)
    return join([box([x - 0.03, y, 0], [x, y + 0.9, 2.05], OAK), *panels, knob])


def _legs(x0: float, y0: float, x1: float, y1: float, top: float, thick: float, material: Material) -> list[Scene]:
    h = thick / 2
    return [box([x - h, y - h, 0], [x + h, y + h, top], material) for x in (x0, x1) for y in (y0, y1)]


def _table(x: float, y: float, width: float, depth: float, height: float) -> Scene:
    w, d = width / 2, depth / 2
    parts = [box([x - w, y - d, height - 0.035], [x + w, y + d, height], OAK)]
    parts += _legs(x - w + 0.06, y - d + 0.06, x + w - 0.06, y + d - 0.06, height - 0.035, 0.06, OAK)
    parts.append(cone([x - 0.2, y, height], [x - 0.2, y, height + 0.24], 0.045, 0.075, CERAMIC))
    parts.append(box([x + 0.15, y - 0.12, height], [x + 0.42, y + 0.07, height + 0.03], BOOKS[1]))
    parts.append(box([x + 0.17, y - 0.1, height + 0.03], [x + 0.39, y + 0.06, height + 0.055], BOOKS[2]))
    return join(parts)


def _chair(x: float, y: float, facing: int) -> Scene:
    """A chair of 0.44 m; its back stands at y - facing * 0.2."""
    parts = [box([x - 0.22, y - 0.22, 0.43], [x + 0.22, y + 0.22, 0.48], SEAT)]
    parts += _legs(x - 0.19, y - 0.19, x + 0.19, y + 0.19, 0.43, 0.035, WALNUT)
    b = y - facing * 0.2
    parts += [box([a - 0.018, b - 0.018, 0.48], [a + 0.018, b + 0.018, 0.92], WALNUT) for a in (x - 0.19, x + 0.19)]
    parts += [box([x - 0.19, b - 0.012, z], [x + 0.19, b + 0.012, z + 0.09], WALNUT) for z in (0.6, 0.8)]
    return join(parts)


def _sofa(x: float, y: float) -> Scene:
    parts = [
        box([x - 1.0, y - 0.42, 0.1], [x + 1.0, y + 0.42, 0.3], SOFA),
        box([x - 0.82, y - 0.45, 0.3], [x - 0.005, y + 0.22, 0.46], SOFA),
        box([x + 0.005, y - 0.45, 0.3], [x + 0.82, y + 0.22, 0.46], SOFA),
        box([x - 1.0, y + 0.2, 0.3], [x + 1.0, y + 0.42, 0.85], SOFA),
        box([x - 1.0, y - 0.42, 0.3], [x - 0.82, y + 0.2, 0.62], SOFA),
        box([x + 0.82, y - 0.42, 0.3], [x + 1.0, y + 0.2, 0.62], SOFA),
        box([x - 0.75, y + 0.04, 0.46], [x - 0.35, y + 0.19, 0.8], CUSHION),
        box([x + 0.3, y + 0.06, 0.46], [x + 0.7, y + 0.2, 0.78], CUSHION_2),
    ]
    return join(parts + _legs(x - 0.9, y - 0.34, x + 0.9, y + 0.34, 0.1, 0.06, WALNUT))


def _coffee_table(x: float, y: float) -> Scene:
    parts = [box([x - 0.5, y - 0.28, 0.36], [x + 0.5, y + 0.28, 0.4], WALNUT)]
    parts += _legs(x - 0.44, y - 0.22, x + 0.44, y + 0.22, 0.36, 0.04, BLACK)
    parts.append(box([x - 0.3, y - 0.12, 0.4], [x - 0.02, y + 0.09, 0.425], BOOKS[6]))
    parts.append(cone([x + 0.25, y, 0.4], [x + 0.25, y, 0.5], 0.045, 0.06, CERAMIC))
    return join(parts)


def _shelf(x: float, y: float, width: float = 1.1, height: float = 2.0, depth: float = 0.34) -> Scene:
    """Five boards with rows of books of random size: the seed is the place, so that the room is always the same."""
    rng = np.random.default_rng([round(1000 * (x + 10)), round(1000 * (y + 10))])
    low, high = np.array([x - width / 2, y - depth / 2, 0]), np.array([x + width / 2, y + depth / 2, height])
    front = -1.0 if y > 0 else 1.0  # the open side looks into the room
    parts = [box(low, [low[0] + 0.025, high[1], height], OAK), box([high[0] - 0.025, low[1], 0], high, OAK)]
    levels = np.linspace(0.06, height - 0.025, 6)
    parts += [box([low[0], low[1], z], [high[0], high[1], z + 0.025], OAK) for z in levels]
    wall_y = high[1] if front < 0 else low[1]
    parts.append(box([low[0], wall_y + front * 0.01 - 0.004, 0], [high[0], wall_y + front * 0.01 + 0.004, height], OAK))
    for z in levels[:-1]:
        at = low[0] + 0.04
        while at < high[0] - 0.1:
            w, h, d = rng.uniform(0.02, 0.055), rng.uniform(0.2, 0.31), rng.uniform(0.17, 0.24)
            if rng.random() < 0.86:
                ends = np.sort([wall_y + front * 0.02, wall_y + front * (0.02 + d)])
                book = BOOKS[rng.integers(len(BOOKS))]
                parts.append(box([at, ends[0], z + 0.025], [at + w, ends[1], z + 0.025 + h], book))
            at += w + 0.003
    return join(parts)


def _sideboard(x: float, y: float) -> Scene:
    parts = [box([x - 0.22, y - 0.75, 0.16], [x + 0.22, y + 0.75, 0.76], WALNUT)]
    parts += [box([x + 0.22, y - 0.73 + k * 0.49, 0.19], [x + 0.235, y - 0.26 + k * 0.49, 0.73], OAK) for k in range(3)]
    parts += _legs(x - 0.16, y - 0.65, x + 0.16, y + 0.65, 0.16, 0.05, BLACK)
    parts.append(cone([x, y + 0.5, 0.76], [x, y + 0.5, 1.02], 0.05, 0.09, POT))
    return join([*parts, box([x - 0.1, y - 0.5, 0.76], [x + 0.1, y - 0.2, 0.82], BOOKS[4])])


def _plant(x: float, y: float) -> Scene:
    """A pot with broad leaves; the seed is the place."""
    rng = np.random.default_rng([7, round(1000 * (x + 10)), round(1000 * (y + 10))])
    parts = [cone([x, y, 0.0], [x, y, 0.36], 0.13, 0.19, POT)]
    for k in range(22):
        azimuth, rise = 2 * np.pi * k / 22 * 5.1, rng.uniform(0.35, 1.2)
        out = np.array([np.cos(azimuth), np.sin(azimuth), 0])
        side = np.array([-np.sin(azimuth), np.cos(azimuth), 0]) * rng.uniform(0.05, 0.09)
        foot = np.array([x, y, 0.34]) + out * 0.04
        reach = out * rng.uniform(0.12, 0.24) + np.array([0, 0, rise * 0.55])
        tip = out * rng.uniform(0.12, 0.2) + np.array([0, 0, rng.uniform(-0.05, 0.15)])
        leaf = LEAF if k % 3 else LEAF_2
        parts.append(rod(foot, foot + reach, 0.008, LEAF, sides=5))
        parts.append(quad(foot + reach - side, 2 * side, tip, leaf))
    return join(parts)


def _floor_lamp(x: float, y: float) -> Scene:
    return join(
        [
            box([x - 0.14, y - 0.14, 0], [x + 0.14, y + 0.14, 0.025], BLACK),
            rod([x, y, 0.02], [x, y, 1.5], 0.013, BLACK),
            cone([x, y, 1.42], [x, y, 1.7], 0.2, 0.13, LAMP),
        ]
    )

"""Images that are hard for finders of checkerboards, and images without a board, for scripts/benchmark_detection.py.

Boards are drawn pixel by pixel, SAMPLES x SAMPLES rays a pixel through the lens, so that their corners are known exactly.
One kind of image, one difficulty; `mixed` has three of them at once. Randomness comes from a generator that is passed in.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from rgbd_calib.geometry import so3
from rgbd_calib.types import Board

WIDTH, HEIGHT = 640, 480
SAMPLES = 4
BOARDS = ((9, 6), (8, 5), (10, 7), (7, 5), (11, 8))


@dataclass(frozen=True)
class Drawn:
    """An image with a board, whole and in view."""

    gray: np.ndarray
    """(h, w), uint8."""
    board: Board
    true_px: np.ndarray
    """(cols * rows, 2): corners, in the board's order or turned by half."""


@dataclass(frozen=True)
class Look:
    """How a board is seen."""

    side_px: tuple[float, float] = (24, 50)
    """Of a square at the board's middle, if it were not tilted."""
    tilt_deg: tuple[float, float] = (0, 40)
    fisheye: bool = False
    white: tuple[float, float] = (170, 230)
    contrast: tuple[float, float] = (110, 160)
    blur_px: tuple[float, float] = (0.4, 0.9)
    motion_px: tuple[float, float] = (0, 0)
    noise: tuple[float, float] = (1, 3)
    glare: bool = False
    shadow: bool = False
    jpeg: tuple[int, int] | None = None


LOOKS: dict[str, Look] = {
    "easy": Look(),
    "20 px squares": Look(side_px=(18, 22)),
    "12 px squares": Look(side_px=(10, 14)),
    "tilt 50-70": Look(tilt_deg=(50, 70)),
    "blur": Look(blur_px=(1.5, 3.5)),
    "motion blur": Look(motion_px=(4, 10)),
    "noise": Look(noise=(8, 25)),
    "glare": Look(glare=True),
    "half shadow": Look(shadow=True),
    "low contrast": Look(white=(60, 200), contrast=(12, 30)),
    "fisheye": Look(fisheye=True),
    "JPEG": Look(jpeg=(8, 30)),
    "mixed": Look(
        side_px=(18, 40),
        tilt_deg=(0, 60),
        blur_px=(0.6, 2),
        contrast=(40, 120),
        noise=(3, 10),
        shadow=True,
        jpeg=(30, 80),
    ),
}


def with_board(kind: str, rng: np.random.Generator, look: Look | None = None) -> Drawn:
    """One image of a kind of LOOKS."""
    look = look or LOOKS[kind]
    cols, rows = BOARDS[rng.integers(len(BOARDS))]
    board = Board(cols, rows, 1.0)
    grid = np.stack(np.divmod(np.arange(board.n_corners), cols)[::-1], axis=1).astype(float)
    while True:  # until the board, with its outer squares, lies in the image
        project, back = _lens(look, rng)
        H, t = _pose(look, board, rng)
        rim = np.array([[c, r] for c in (-1.0, cols) for r in (-1.0, rows)] + [[cols / 2, -1], [-1, rows / 2]])
        seen = project(_placed(rim, H, t))
        corners = project(_placed(grid, H, t))
        low, high = np.array([-0.5, -0.5]), np.array([WIDTH, HEIGHT]) - 0.5
        if np.all((seen > low) & (seen < high)) and _smallest_side(board, corners) > 4.5:
            break
    gray = _paint(look, board, H, t, back, rng)
    return Drawn(_develop(look, gray, corners, rng), board, corners)


def without_board(rng: np.random.Generator, scenes: list[np.ndarray]) -> np.ndarray:
    """An image (h, w), uint8, that holds no checkerboard: textures, clutter, tiles, windows, plaids, parts of `scenes`."""
    kinds: list[Callable[[np.random.Generator], np.ndarray]] = [_texture, _clutter, _tiles, _windows, _plaid, _mosaic]
    pick = int(rng.integers(len(kinds) + (2 if scenes else 0)))
    if pick < len(kinds):
        image = kinds[pick](rng)
        if rng.random() < 0.6:
            image = _seen_askew(image, rng)
    else:
        image = _part_of(scenes[rng.integers(len(scenes))], rng)
    image = cv2.GaussianBlur(image.astype(np.float32), (0, 0), rng.uniform(0.4, 1.5))
    return _to_bytes(image + rng.normal(0, rng.uniform(0.5, 6), image.shape))


def _smallest_side(board: Board, corners: np.ndarray) -> float:
    grid = corners.reshape(board.rows, board.cols, 2)
    return float(min(np.linalg.norm(np.diff(grid, axis=a), axis=-1).min() for a in (0, 1)))


def _lens(look: Look, rng: np.random.Generator) -> tuple[Callable[..., np.ndarray], Callable[..., np.ndarray]]:
    """From directions (n, 3) to pixels (n, 2), and back."""
    middle = np.array([WIDTH - 1, HEIGHT - 1]) / 2
    if not look.fisheye:
        f = rng.uniform(450, 650)

        def project(p: np.ndarray) -> np.ndarray:
            return np.where(p[:, 2:] > 0.1, f * p[:, :2] / np.maximum(p[:, 2:], 0.1) + middle, -1e4)

        def back(px: np.ndarray) -> np.ndarray:
            return np.column_stack([(px - middle) / f, np.ones(len(px))])

        return project, back
    f = rng.uniform(200, 260)  # equidistant: 140 to 180 degrees over the image's width

    def project_wide(p: np.ndarray) -> np.ndarray:
        side = np.linalg.norm(p[:, :2], axis=1, keepdims=True)
        angle = np.arctan2(side, p[:, 2:])
        return f * angle * p[:, :2] / np.maximum(side, 1e-12) + middle

    def back_wide(px: np.ndarray) -> np.ndarray:
        off = px - middle
        angle = np.linalg.norm(off, axis=1, keepdims=True) / f
        return np.column_stack([np.sinc(angle / np.pi) * off / f, np.cos(angle)])

    return project_wide, back_wide


def _pose(look: Look, board: Board, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The board's axes as columns (3, 2), and the place of its middle (3,), in squares."""
    side, tilt = rng.uniform(*look.side_px), np.deg2rad(rng.uniform(*look.tilt_deg))
    f = 230.0 if look.fisheye else 550.0
    about = rng.uniform(0, 2 * np.pi)
    R = so3.exp(tilt * np.array([np.cos(about), np.sin(about), 0])) @ so3.exp(
        np.array([0, 0, rng.uniform(0, 2 * np.pi)])
    )
    z = f / side
    reach = np.array([WIDTH, HEIGHT]) / 2 / f * z
    t = np.array([*rng.uniform(-reach, reach), z])
    if look.fisheye:  # anywhere in the field of view, facing the camera
        aside = rng.uniform(0, 0.45) * np.pi
        turn = so3.exp(aside * np.array([-np.sin(about), np.cos(about), 0]))
        R, t = turn @ R, turn @ np.array([0, 0, z])
    return R[:, :2], t - R[:, :2] @ (np.array([board.cols, board.rows]) - 1) * 0.5


def _placed(grid: np.ndarray, axes: np.ndarray, t: np.ndarray) -> np.ndarray:
    return np.asarray(grid @ axes.T + t)


def _paint(
    look: Look, board: Board, axes: np.ndarray, t: np.ndarray, back: Callable[..., np.ndarray], rng: np.random.Generator
) -> np.ndarray:
    """The board over clutter, (h, w) float32, grey steps, without blur and noise."""
    white = rng.uniform(*look.white)
    black = max(white - rng.uniform(*look.contrast), 3)
    margin = rng.uniform(0.2, 1.2)
    out = _clutter(rng).astype(np.float32)
    if look.contrast[1] < 60:  # the whole scene is as flat as the board
        out = white - 60 + 0.3 * out
    M = np.linalg.inv(np.column_stack([axes, t]))
    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    y, x = (g.ravel() for g in np.mgrid[:HEIGHT, :WIDTH].astype(float))
    total, covered = np.zeros(len(x)), np.zeros(len(x))
    for dy in steps:
        for dx in steps:
            on = back(np.column_stack([x + dx, y + dy])) @ M.T
            ahead = on[:, 2] > 1e-9
            c, r = (on[:, i] / np.where(ahead, on[:, 2], 1) for i in (0, 1))
            paper = (
                ahead & (c > -1 - margin) & (c < board.cols + margin) & (r > -1 - margin) & (r < board.rows + margin)
            )
            squares = (c > -1) & (c < board.cols) & (r > -1) & (r < board.rows)
            dark = squares & ((np.floor(c) + np.floor(r)) % 2 == 0)
            total += np.where(paper, np.where(dark, black, white), 0)
            covered += paper
    share = covered / SAMPLES**2
    return np.asarray(out.ravel() * (1 - share) + total / SAMPLES**2, np.float32).reshape(HEIGHT, WIDTH)


def _develop(look: Look, light: np.ndarray, corners: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    extent = float(np.linalg.norm(np.ptp(corners, axis=0)))
    if look.shadow:
        middle, angle = corners[rng.integers(len(corners))], rng.uniform(0, 2 * np.pi)
        off = (x - middle[0]) * np.cos(angle) + (y - middle[1]) * np.sin(angle)
        light = light * (1 - rng.uniform(0.5, 0.8) / (1 + np.exp(-off / rng.uniform(0.5, 8))))
    if look.glare:
        middle, size = corners[rng.integers(len(corners))], extent * rng.uniform(0.08, 0.25)
        light = light + rng.uniform(60, 150) * np.exp(-((x - middle[0]) ** 2 + (y - middle[1]) ** 2) / (2 * size**2))
    light = cv2.GaussianBlur(light.astype(np.float32), (0, 0), rng.uniform(*look.blur_px))
    length = rng.uniform(*look.motion_px)
    if length > 0:
        light = cv2.filter2D(light, -1, _streak(length, rng.uniform(0, np.pi)))
    gray = _to_bytes(light + rng.normal(0, rng.uniform(*look.noise), light.shape))
    if look.jpeg is not None:
        quality = int(rng.integers(*look.jpeg))
        gray = cv2.imdecode(cv2.imencode(".jpg", gray, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_GRAYSCALE)
    return gray


def _streak(length: float, angle: float) -> np.ndarray:
    half = int(np.ceil(length / 2)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for s in np.linspace(-length / 2, length / 2, 101):
        u, v = half + s * np.cos(angle), half + s * np.sin(angle)
        i, j = int(np.floor(v)), int(np.floor(u))
        for di, dj in ((0, 0), (0, 1), (1, 0), (1, 1)):
            kernel[i + di, j + dj] += (1 - abs(v - i - di)) * (1 - abs(u - j - dj))
    return kernel / kernel.sum()


def _to_bytes(image: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _texture(rng: np.random.Generator) -> np.ndarray:
    """Noise of several wavelengths."""
    total = np.zeros((HEIGHT, WIDTH), np.float32)
    for sigma in 2.0 ** np.arange(0, 6):
        layer = cv2.GaussianBlur(rng.standard_normal((HEIGHT, WIDTH)).astype(np.float32), (0, 0), sigma)
        total += layer / layer.std() * rng.uniform(0, 1)
    return 128 + rng.uniform(15, 70) * total / max(float(total.std()), 1e-3)


def _clutter(rng: np.random.Generator) -> np.ndarray:
    """Rectangles, lines and discs, one over the other."""
    image = np.full((HEIGHT, WIDTH), rng.uniform(40, 200), np.float32)
    for _ in range(rng.integers(5, 120)):
        centre, size = rng.uniform([0, 0], [WIDTH, HEIGHT]), rng.uniform(4, 120, 2)
        box = cv2.boxPoints((tuple(centre), tuple(size), float(rng.uniform(0, 180)))).astype(np.int32)
        shape, shade = rng.integers(4), float(rng.uniform(0, 255))
        if shape == 0:
            cv2.circle(image, tuple(int(v) for v in centre), int(size[0] / 3), shade, -1)
        elif shape == 1:
            cv2.line(image, tuple(map(int, box[0])), tuple(map(int, box[2])), shade, int(rng.integers(1, 8)))
        else:
            cv2.fillConvexPoly(image, box, shade)
    return image


def _cells(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of a regular grid: column and row (h, w) of each pixel's cell, and where in it the pixel is, 0 to 1."""
    size = rng.uniform(10, 60, 2) if rng.random() < 0.5 else np.repeat(rng.uniform(10, 60), 2)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + rng.uniform(0, 60, (2, 1, 1))
    return np.floor(x / size[0]), np.floor(y / size[1]), x / size[0] % 1, y / size[1] % 1


def _tiles(rng: np.random.Generator) -> np.ndarray:
    """Tiles of random shades with joints; every second row may be shifted, as bricks are."""
    column, row, u, v = _cells(rng)
    if rng.random() < 0.4:
        shifted = u + 0.5 * (row % 2)
        column, u = column + np.floor(shifted), shifted % 1
    shades = rng.uniform(60, 220) + rng.uniform(2, 40) * rng.standard_normal((70, 90))
    joint = rng.uniform(0.02, 0.2)
    image = shades[row.astype(int) % 70, column.astype(int) % 90]
    return np.where((u < joint) | (v < joint), rng.uniform(0, 255), image)


def _windows(rng: np.random.Generator) -> np.ndarray:
    """Facades: panes in a frame, each with a bar or a lit half, on a wall."""
    _, _, u, v = _cells(rng)
    wall, pane, bar = rng.uniform(0, 255, 3)
    left, top, thick = *rng.uniform(0.05, 0.35, 2), rng.uniform(0.03, 0.12)
    image = np.where((u > left) & (u < 1 - left) & (v > top) & (v < 1 - top), pane, wall)
    if rng.random() < 0.5:
        image = np.where((np.abs(u - 0.5) < thick) & (v > top) & (v < 1 - top), bar, image)
    if rng.random() < 0.5:
        image = np.where((np.abs(v - 0.5) < thick) & (u > left) & (u < 1 - left), bar, image)
    if rng.random() < 0.3:
        image = np.where((image == pane) & (u > 0.5) == (v > 0.5), bar, image)
    return image


def _plaid(rng: np.random.Generator) -> np.ndarray:
    """Gingham: stripes both ways, the sum of two waves or of two rows of bars."""
    column, row, u, v = _cells(rng)
    strength = rng.uniform(20, 60, 2)
    if rng.random() < 0.5:
        return 128 + strength[0] * np.sin(2 * np.pi * u) + strength[1] * np.sin(2 * np.pi * v)
    return 128 + strength[0] * (column % 2 - 0.5) + strength[1] * (row % 2 - 0.5)


def _mosaic(rng: np.random.Generator) -> np.ndarray:
    """Cells that are black or white by chance, as in codes and crosswords; a share of them follows a checkerboard."""
    column, row, _, _ = _cells(rng)
    board = (column + row) % 2
    lot = rng.random((70, 90))[row.astype(int) % 70, column.astype(int) % 90]
    dark = np.where(lot < rng.choice([0.0, 0.3, 0.6]), board, lot * 7 % 1 < 0.5)
    return np.where(dark > 0, *rng.uniform([20, 150], [100, 235]))


def _seen_askew(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    frame = np.array([[0, 0], [WIDTH, 0], [WIDTH, HEIGHT], [0, HEIGHT]], np.float32)
    there = frame + rng.uniform(-0.25, 0.25, (4, 2)) * [WIDTH, HEIGHT]
    H = cv2.getPerspectiveTransform(frame, there.astype(np.float32))
    return cv2.warpPerspective(image.astype(np.float32), H, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)


def _part_of(scene: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A random part of a picture without a board, turned, enlarged, in another light."""
    turn = cv2.getRotationMatrix2D(
        (scene.shape[1] / 2, scene.shape[0] / 2), float(rng.uniform(-30, 30)), float(rng.uniform(1, 2.5))
    )
    turn[:, 2] += rng.uniform(-0.3, 0.3, 2) * [WIDTH, HEIGHT]
    part = cv2.warpAffine(scene.astype(np.float32), turn, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)
    part = part[:, ::-1] if rng.random() < 0.5 else part
    return np.asarray(part * rng.uniform(0.5, 1.3))


def room_pictures(n: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """The simulator's furnished room, (h, w) uint8, from `n` random places."""
    from rgbd_calib.simulation.color_sensor import ColorNoise, develop
    from rgbd_calib.simulation.render import render_room
    from rgbd_calib.simulation.rig import look_at, true_intrinsics
    from rgbd_calib.simulation.room import furnished_room
    from rgbd_calib.simulation.scene import Caster
    from rgbd_calib.simulation.view import View

    caster = Caster(furnished_room())
    low, high = caster.scene.corners_m.min(axis=0), caster.scene.corners_m.max(axis=0)
    for _ in range(n):
        eye, target = (rng.uniform(low + 0.15 * (high - low), high - 0.15 * (high - low)) for _ in range(2))
        T = look_at(eye, target, float(rng.uniform(-0.2, 0.2)))
        picture = render_room(View(true_intrinsics(WIDTH, HEIGHT, rng), T), caster, rng)
        yield cv2.cvtColor(develop(picture, ColorNoise(), rng), cv2.COLOR_BGR2GRAY)

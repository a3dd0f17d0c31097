"""Spoils some views of a recording, each in one way that happens in practice, to see what a calibration makes of it.

The room does not move, so its picture without the board is the median over a camera's frames; the board is cut out
along its outline, which follows from its corners, and put elsewhere.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import cv2
import numpy as np

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io import recording as files
from rgbd_calib.io.files import whole_folder
from rgbd_calib.simulation.board import outline_m
from rgbd_calib.types import Board

Kind = Literal["clutter", "turned", "hand", "blurred", "late_depth", "moved"]
"""clutter: the board is hidden and a pattern like it hangs elsewhere; turned: upside down in one camera; hand: something
5-15 cm before part of the board in the depth; blurred: colour smeared by motion; late_depth: the board moved between
colour and depth; moved: the board moved between this camera's shot and the others'."""

_FRAMES_FOR_ROOM = 15
_FEATHER_PX = 1.5

ViewCorners = Mapping[tuple[str, str], FloatArray]


@dataclass(frozen=True)
class _Images:
    """One view, before it is spoiled."""

    color: np.ndarray
    """(h, w, 3), uint8, B G R."""
    depth_raw: np.ndarray
    """(h, w), uint16, 0 = none."""
    room_color: np.ndarray
    room_depth_raw: np.ndarray
    mask: np.ndarray
    """(h, w) in [0, 1]: the board's share of each pixel."""
    grid_px: FloatArray
    """(rows, cols, 2) of the corners."""
    units_per_m: float


def true_corners(csv_file: Path, recording: str = "extrinsic") -> dict[tuple[str, str], FloatArray]:
    """Corners (n, 2), px, by camera and frame, of the views in a true_corners.csv that show the whole board."""
    rows: dict[tuple[str, str], list[tuple[float, float]]] = {}
    partial = set()
    columns = ("recording", "camera", "frame", "u_px", "v_px", "visible")
    for line, row in files.read_table(csv_file, columns):
        if row["recording"] != recording:
            continue
        key = (row["camera"], row["frame"])
        if row["visible"] != "1":
            partial.add(key)
        u, v = (files.number(csv_file, line, name, row[name]) for name in ("u_px", "v_px"))
        rows.setdefault(key, []).append((u, v))
    return {key: np.array(px) for key, px in rows.items() if key not in partial}


def spoil(
    source: Path, out: Path, kind: Kind, corners_px: ViewCorners, share: float, rng: np.random.Generator
) -> tuple[tuple[str, str], ...]:
    """Copy a recording to `out` with a `share` of its views spoiled; returns (camera, frame) of those.

    `corners_px` (n, 2) by camera and frame are the views that show the board: one of them at least is spoiled.

    Raises
    ------
    ConfigError
        Another kind than there is, no board in dataset.yaml, or `out` exists.
    CalibrationError
        No view shows the board.
    """
    if kind not in get_args(Kind):
        raise ConfigError(f"spoil: {kind!r} seen, one of {', '.join(get_args(Kind))} needed. Correct it")
    if out.exists():
        raise ConfigError(f"{out}: exists already; a new folder is needed. Choose another name")
    recording = files.open_recording(source)
    if recording.board is None:
        raise ConfigError(f"{source / 'dataset.yaml'}: board is missing; the board's size is needed. Add it")
    views = sorted(key for key in corners_px if recording.has_depth(*key))
    if not views:
        raise CalibrationError(f"{source}: no view shows the whole board; one at least is needed. Record the board")
    count = min(len(views), max(1, round(share * len(views))))
    chosen = tuple(sorted(views[i] for i in rng.choice(len(views), count, replace=False)))
    rooms = {camera: _empty_room(recording, camera) for camera in {camera for camera, _ in chosen}}
    with whole_folder(out) as folder:
        shutil.copytree(source, folder, dirs_exist_ok=True)
        for (camera, frame), child in zip(chosen, rng.spawn(len(chosen)), strict=True):
            images = _view(recording, rooms[camera], camera, frame, corners_px[camera, frame])
            color, depth_raw = _KINDS[kind](images, recording.board, child)
            files.save_color(folder, camera, frame, color)
            files.save_depth(folder, camera, frame, depth_raw)
    return chosen


def _view(
    recording: files.Recording, room: tuple[np.ndarray, np.ndarray], camera: str, frame: str, corners_px: FloatArray
) -> _Images:
    board, units_per_m = recording.board, 1 / recording.cameras[camera].depth_scale
    assert board is not None
    H_px_board = cv2.findHomography(board.corners_m()[:, :2], corners_px)[0]
    low, high = outline_m(board)
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    outline = cv2.perspectiveTransform(corners[None], H_px_board)[0]
    info = recording.cameras[camera]
    mask = np.zeros((info.height, info.width), np.float32)
    cv2.fillConvexPoly(mask, np.round(outline).astype(np.int32), 1.0)
    mask = np.clip(2 * cv2.GaussianBlur(cv2.dilate(mask, np.ones((3, 3))), (0, 0), _FEATHER_PX), 0, 1)
    grid = corners_px.reshape(board.rows, board.cols, 2)
    return _Images(recording.color(camera, frame), _raw(recording, camera, frame), *room, mask, grid, units_per_m)


def _raw(recording: files.Recording, camera: str, frame: str) -> np.ndarray:
    depth_m = recording.depth_m(camera, frame)
    return np.round(np.nan_to_num(depth_m) / recording.cameras[camera].depth_scale).astype(np.uint16)


def _empty_room(recording: files.Recording, camera: str) -> tuple[np.ndarray, np.ndarray]:
    """Colour and depth, as in a recording, of what stands still before one camera."""
    frames = [f for f in recording.color_files[camera] if recording.has_depth(camera, f)]
    some = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, _FRAMES_FOR_ROOM).astype(int))]
    color = np.median([recording.color(camera, f) for f in some], axis=0).astype(np.uint8)
    depth_raw = np.median([_raw(recording, camera, f) for f in some], axis=0).astype(np.uint16)
    return color, depth_raw


def _relocate(images: _Images, H: FloatArray, dz_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """The view with its board carried by the homography H (3, 3), px to px, and farther by `dz_m`."""
    h, w = images.mask.shape
    mask = cv2.warpPerspective(images.mask, H, (w, h))
    color = cv2.warpPerspective(images.color, H, (w, h), flags=cv2.INTER_CUBIC)
    bare = _blend(images.color, images.room_color, images.mask)
    depth = cv2.warpPerspective(images.depth_raw, H, (w, h), flags=cv2.INTER_NEAREST).astype(float)
    depth = np.where(depth > 0, depth + dz_m * images.units_per_m, 0)
    bare_depth = np.where(images.mask > 0.5, images.room_depth_raw, images.depth_raw)
    depth_raw = np.where(mask > 0.5, np.clip(np.round(depth), 0, 65535), bare_depth).astype(np.uint16)
    return _blend(bare, color, mask), depth_raw


def _blend(under: np.ndarray, over: np.ndarray, share: np.ndarray) -> np.ndarray:
    mixed = under * (1 - share[..., None]) + over * share[..., None]
    return np.round(mixed).astype(np.uint8)


def _shift(dx: float, dy: float) -> FloatArray:
    return np.array([[1.0, 0, dx], [0, 1.0, dy], [0, 0, 1.0]])


def _clutter(images: _Images, board: Board, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    h, w = images.mask.shape
    low, high = images.grid_px.min(axis=(0, 1)), images.grid_px.max(axis=(0, 1))
    # the farthest of some places that hold the whole pattern
    places = rng.uniform(-low + 10, np.maximum([w - 10, h - 10] - high, -low + 11), (30, 2))
    dx, dy = places[np.argmax(np.linalg.norm(places, axis=1))]
    return _relocate(images, _shift(dx, dy))[0], images.depth_raw


def _turned(images: _Images, board: Board, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    px = images.grid_px.reshape(-1, 2)
    half_turn = np.asarray(cv2.findHomography(px, px[::-1])[0], float)
    return _relocate(images, half_turn)[0], images.depth_raw


def _hand(images: _Images, board: Board, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    h, w = images.mask.shape
    centre = images.grid_px.reshape(-1, 2)[rng.integers(board.n_corners)]
    size = np.ptp(images.grid_px, axis=(0, 1))
    y, x = np.mgrid[:h, :w]
    a, b = size * rng.uniform(0.2, 0.35, 2)
    blob = ((x - centre[0]) / a) ** 2 + ((y - centre[1]) / b) ** 2 < 1 + 0.2 * np.sin(
        5 * np.arctan2(y - centre[1], x - centre[0])
    )
    nearer = rng.uniform(0.05, 0.15) * images.units_per_m
    inside = blob & (images.depth_raw > nearer)
    return images.color, np.where(inside, images.depth_raw - nearer, images.depth_raw).astype(np.uint16)


def _blurred(images: _Images, board: Board, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    length, angle = rng.uniform(8, 20), rng.uniform(0, np.pi)
    n = 25
    kernel = np.zeros((n, n), np.float32)
    middle, step = np.array([n // 2, n // 2]), length / 2 * np.array([np.cos(angle), np.sin(angle)])
    ends = [tuple(round(v) for v in middle + s * step) for s in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], 1.0)
    return cv2.filter2D(images.color, -1, kernel / kernel.sum()), images.depth_raw


def _small_motion(images: _Images, rng: np.random.Generator) -> tuple[FloatArray, float]:
    """A homography of 5-15 px with a turn of up to 4 degrees, and 2-5 cm along the axis."""
    way, turn = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(-4, 4))
    middle, far = images.grid_px.mean(axis=(0, 1)), rng.uniform(5, 15)
    about = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1.0]])
    H = _shift(far * np.cos(way), far * np.sin(way)) @ _shift(*middle) @ about @ _shift(*-middle)
    return H, rng.choice([-1, 1]) * rng.uniform(0.02, 0.05)


def _late_depth(images: _Images, board: Board, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return images.color, _relocate(images, *_small_motion(images, rng))[1]


def _moved(images: _Images, board: Board, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return _relocate(images, *_small_motion(images, rng))


_KINDS: dict[str, Callable[[_Images, Board, np.random.Generator], tuple[np.ndarray, np.ndarray]]] = {
    "clutter": _clutter,
    "turned": _turned,
    "hand": _hand,
    "blurred": _blurred,
    "late_depth": _late_depth,
    "moved": _moved,
}

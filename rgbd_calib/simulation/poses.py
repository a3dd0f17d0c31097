"""Where the board stands in each frame: drawn at random, kept where it can be seen, chosen to spread over images,
distances and tilts."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.patterns.black import cell_m
from rgbd_calib.simulation import board as boards
from rgbd_calib.simulation.rig import TrueRig
from rgbd_calib.simulation.scene import Caster
from rgbd_calib.types import Board

_MARGIN_PX = 8.0
_SHARED_RANGE_M = (1.3, 3.2)
_CLOSE_RANGE_M = (0.5, 1.5)
_SHARED_TILT_COS, _CLOSE_TILT_COS = np.cos(np.radians(50.0)), np.cos(np.radians(42.0))
_MIN_SQUARE_PX = 8.5
"""Narrower squares than this are lost on a detector."""
_MIN_CELL_PX = 1.6
"""Narrower cells of markers than this are lost."""
_PART = 0.4
"""Share of the corners that a view of a board with markers has in the image at least; a checkerboard has all."""
_CLEAR_M = 0.04
_DRAWS = 6000
"""Poses in the pool that a recording's frames are chosen from."""
_POOLS = 5
"""Pools to try before giving up."""


@dataclass(frozen=True)
class _Candidates:
    T_room_board: FloatArray
    """(n, 4, 4)."""
    seen: np.ndarray
    """(n, cameras) bool: corners enough in the image, near enough and square enough to be found."""
    traits: FloatArray
    """(n, cameras, 5): u, v, z of the board's middle and two components of its normal, each scaled to about 0-1."""
    corners_px: FloatArray
    """(n, cameras, n_corners, 2) of the face that the camera looks at."""
    inside: np.ndarray
    """(n, cameras, n_corners) bool: in the image."""


def shared_poses(
    rig: TrueRig, board: Board, frames: int, room: Caster, rng: np.random.Generator
) -> tuple[FloatArray, ...]:
    """T_room_board (4, 4) of frames that at least two cameras see, each camera and pair about equally often.

    Raises
    ------
    CalibrationError
        No pose of the board is seen by two cameras.
    """
    n = len(rig.cameras)
    pairs = list(combinations(range(n), 2))
    pair_count, camera_count = dict.fromkeys(pairs, 0), np.zeros(n)
    taken = np.zeros((0, n, 5))
    taken_seen = np.zeros((0, n), bool)
    chosen: list[FloatArray] = []
    for _ in range(_POOLS):
        pool = _draw(rig, board, rng, _SHARED_RANGE_M, _SHARED_TILT_COS)
        open_ = pool.seen.sum(axis=1) >= 2
        while len(chosen) < frames and open_.any():
            good = np.flatnonzero(open_)
            rare = np.max([np.all(pool.seen[good][:, p], axis=1) / (1 + pair_count[p]) for p in pairs], axis=0)
            score = _novelty(pool, good, taken, taken_seen) * (pool.seen[good] @ (1 / (1 + camera_count)) + rare)
            i = good[np.argmax(score)]
            open_[i] = False
            who = np.flatnonzero(pool.seen[i])
            if not (
                _clear(board, pool.T_room_board[i], room) and _unhidden(rig, board, pool.T_room_board[i], who, room)
            ):
                continue
            chosen.append(pool.T_room_board[i])
            taken = np.concatenate([taken, pool.traits[i : i + 1]])
            taken_seen = np.concatenate([taken_seen, pool.seen[i : i + 1]])
            camera_count += pool.seen[i]
            for p in combinations(who.tolist(), 2):
                pair_count[p] += 1
        if len(chosen) == frames:
            return tuple(chosen)
    raise CalibrationError(_nothing_seen(rig, board))


def close_poses(
    rig: TrueRig, board: Board, which: str, views: int, room: Caster, rng: np.random.Generator
) -> tuple[FloatArray, ...]:
    """T_room_board (4, 4) of views close to one camera that together fill its image to the borders.

    Raises
    ------
    CalibrationError
        The board cannot be seen by this camera.
    """
    alone = TrueRig({which: rig.intrinsics[which]}, {which: rig.T_room_color[which]}, {which: rig.depth_bias[which]})
    K = rig.intrinsics[which]
    covered = np.zeros((12, 16))
    taken = np.zeros((0, 1, 5))
    chosen: list[FloatArray] = []
    for _ in range(_POOLS):
        pool = _draw(alone, board, rng, _CLOSE_RANGE_M, _CLOSE_TILT_COS)
        px, inside = pool.corners_px[:, 0], pool.inside[:, 0]
        cell_v = np.clip(px[..., 1] / K.height * 12, 0, 11).astype(int)
        cell_u = np.clip(px[..., 0] / K.width * 16, 0, 15).astype(int)
        open_ = pool.seen[:, 0].copy()
        while len(chosen) < views and open_.any():
            good = np.flatnonzero(open_)
            fresh = (1 / (1 + covered[cell_v[good], cell_u[good]]) ** 2).mean(axis=1, where=inside[good])
            novelty = _novelty(pool, good, taken, np.ones((len(taken), 1), bool))
            i = good[np.argmax(fresh * (0.3 + novelty))]
            open_[i] = False
            if not _clear(board, pool.T_room_board[i], room):
                continue
            chosen.append(pool.T_room_board[i])
            np.add.at(covered, (cell_v[i, inside[i]], cell_u[i, inside[i]]), 1)
            taken = np.concatenate([taken, pool.traits[i : i + 1]])
        if len(chosen) == views:
            return tuple(chosen)
    raise CalibrationError(_nothing_seen(rig, board))


def looks_at_back(T_color_board: FloatArray, board: Board) -> np.ndarray:
    """Does a camera look at the back of the board? For poses (..., 4, 4)."""
    middle = boards.grid_m(board).mean(axis=0)
    at = T_color_board[..., :3, :3] @ middle + T_color_board[..., :3, 3]
    return np.einsum("...i,...i->...", at, T_color_board[..., :3, 2]) < 0


def _draw(
    rig: TrueRig, board: Board, rng: np.random.Generator, range_m: tuple[float, float], tilt_cos: float
) -> _Candidates:
    """Poses around a random camera each: anywhere in its image, turned towards it or, if the board has two faces,
    away from it."""
    names, n = rig.cameras, _DRAWS
    who = rng.integers(len(names), size=n)
    z = rng.uniform(*range_m, n)
    where = rng.uniform(0.02, 0.98, (n, 2))
    middle = boards.grid_m(board).mean(axis=0)
    # a board straight ahead has its x to the right, y down, z away; then tilt by up to the limit, roll, flip
    tilt = np.arccos(rng.uniform(tilt_cos, 1, n)) * rng.choice([0.35, 1.0], n)
    way, roll = rng.uniform(0, 2 * np.pi, n), np.radians(rng.uniform(-25, 25, n))
    zero = np.zeros(n)
    flip = np.pi * (rng.random(n) < 0.5) if board.two_sided else zero
    R = (
        so3.exp(np.stack([tilt * np.cos(way), tilt * np.sin(way), zero], 1))
        @ so3.exp(np.stack([zero, zero, roll], 1))
        @ so3.exp(np.stack([zero, flip, zero], 1))
    )
    T = np.empty((n, 4, 4))
    for k, name in enumerate(names):
        mine = np.flatnonzero(who == k)
        K = rig.intrinsics[name]
        ray = K.rays(where[mine] * [K.width - 1, K.height - 1])
        # turned so that "straight ahead" is along the ray
        axis = np.cross([0.0, 0.0, 1.0], ray)
        angle = np.arctan2(np.linalg.norm(axis, axis=1), ray[:, 2])
        R_ray = so3.exp(axis / np.maximum(np.linalg.norm(axis, axis=1), 1e-12)[:, None] * angle[:, None])
        R_color_board = R_ray @ R[mine]
        t = ray * z[mine, None] - R_color_board @ middle
        T[mine] = rig.T_room_color[name] @ se3.make(R_color_board, t)
    return _judge(rig, board, T, range_m, tilt_cos)


def _judge(rig: TrueRig, board: Board, T: FloatArray, range_m: tuple[float, float], tilt_cos: float) -> _Candidates:
    middle = boards.grid_m(board).mean(axis=0)
    n, m = len(T), len(rig.cameras)
    seen, traits = np.zeros((n, m), bool), np.zeros((n, m, 5))
    corners_px, in_image = np.zeros((n, m, board.n_corners, 2)), np.zeros((n, m, board.n_corners), bool)
    flat = board.corners_m()[None, :, :2]
    least, least_px_per_m = float(board.n_corners), _MIN_SQUARE_PX / board.square_m
    if board.type != "checkerboard":
        least, least_px_per_m = _PART * board.n_corners, _MIN_CELL_PX / cell_m(board)
    for k, name in enumerate(rig.cameras):
        K = rig.intrinsics[name]
        T_color_board = se3.inverse(rig.T_room_color[name]) @ T
        back = looks_at_back(T_color_board, board)
        corners = np.where(back[:, None, None], board.corners_m(back=True), board.corners_m())
        p = np.einsum("nij,nkj->nki", T_color_board[:, :3, :3], corners) + T_color_board[:, None, :3, 3]
        at = T_color_board[:, :3, :3] @ middle + T_color_board[:, :3, 3]
        normal = T_color_board[:, :3, 2] * np.where(back, -1.0, 1.0)[:, None]
        cos = np.einsum("ni,ni->n", at, normal) / np.linalg.norm(at, axis=1)
        with np.errstate(all="ignore"):
            px = K.project(p)
            x, y = p[..., 0] / p[..., 2], p[..., 1] / p[..., 2]
            bounds = np.abs(K.rays(np.array([[-0.5, -0.5], [K.width - 0.5, K.height - 0.5]]))[:, :2])
            sane = (np.abs(x) < 1.2 * bounds[:, 0].max()) & (np.abs(y) < 1.2 * bounds[:, 1].max())
        inside = np.all((px > _MARGIN_PX) & (px < np.array([K.width, K.height]) - 1 - _MARGIN_PX), axis=-1) & sane
        px_per_m = _sides(np.where(inside[..., None], px, np.nan), board) / _sides(flat, board)
        seen[:, k] = (
            (inside.sum(axis=1) >= least)
            & np.all(p[..., 2] > 0.3, axis=1)
            & (at[:, 2] > range_m[0])
            & (at[:, 2] < range_m[1])
            & (cos > tilt_cos)
            & (np.fmin.reduce(px_per_m, axis=1) > least_px_per_m * K.width / 640)
            & (board.two_sided | ~back)
        )
        total_px = px.sum(axis=1, where=inside[..., None])
        traits[:, k, :2] = total_px / np.maximum(inside.sum(axis=1), 1)[:, None] / [K.width, K.height]
        traits[:, k, 2] = (at[:, 2] - range_m[0]) / (range_m[1] - range_m[0])
        traits[:, k, 3:] = 0.5 + 0.5 * normal[:, :2]
        corners_px[:, k], in_image[:, k] = px, inside
    return _Candidates(T, seen, traits, corners_px, in_image)


def _sides(corners: FloatArray, board: Board) -> FloatArray:
    """Distances (n, k) between neighbours of corners (n, n_corners, 2)."""
    grid = corners.reshape(-1, board.rows, board.cols, 2)
    sides = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).reshape(len(grid), -1) for axis in (1, 2)]
    return np.concatenate(sides, axis=1)


def _novelty(pool: _Candidates, good: np.ndarray, taken: FloatArray, taken_seen: np.ndarray) -> FloatArray:
    """How different (n,) the views of candidates are from those taken so far, the mean over the cameras that see
    them of the distance to the nearest of their views."""
    total = np.zeros(len(good))
    for k in range(pool.seen.shape[1]):
        mine = taken[taken_seen[:, k], k]
        near = np.ones(len(good))
        if len(mine):
            near = np.linalg.norm(pool.traits[good, k][:, None] - mine[None], axis=-1).min(axis=1)
        total += np.where(pool.seen[good, k], np.minimum(near, 1), 0)
    return total / np.maximum(pool.seen[good].sum(axis=1), 1)


def _clear(board: Board, T_room_board: FloatArray, room: Caster) -> bool:
    """Does the board hang free in the room?"""
    points = se3.transform(T_room_board, boards.grid_m(board))
    return bool(points[:, 2].min() > 0.1 and room.distance_m(points).min() > _CLEAR_M)


def _unhidden(rig: TrueRig, board: Board, T_room_board: FloatArray, who: np.ndarray, room: Caster) -> bool:
    """Is no furniture between the board and the cameras that should see it?"""
    points = se3.transform(T_room_board, boards.grid_m(board))
    for k in who:
        eye = rig.T_room_color[rig.cameras[k]][:3, 3]
        if room.blocked(np.broadcast_to(eye, points.shape), points - eye, 0.999).any():
            return False
    return True


def _nothing_seen(rig: TrueRig, board: Board) -> str:
    return (
        f"simulate: {len(rig.cameras)} cameras: no place found where the board of {board.cols}x{board.rows} corners, "
        f"squares of {board.square_m * 1000:g} mm, is seen whole; a smaller board or more cameras are needed. "
        "Change --square, --board or --cameras"
    )

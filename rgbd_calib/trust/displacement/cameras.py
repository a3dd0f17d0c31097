"""Where the cameras stand by some frames, lenses and depth biases as they are, and how sure that is.

A view v of camera c in frame f puts the board at W_v = T_world_color[c] T_color_board. With delta_c the displacement of
the camera and b_f that of the board's pose B_f, both left perturbations in the world, and y_v = W_v (-) B_f,

    y_v + delta_c - b_f = 0,     with the information of the view's own fit, carried into the world

is linear in the unknowns; it is solved again from the displaced poses until they stay, so that displacements may be
large. Only relative places show: one camera, the anchor, is held. A view that fits badly loses its weight (Tukey's),
and the covariance is scaled by what the views' disagreement says of the noise, where it says more than was assumed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.linear import BoolArray, Pattern, Rows, assemble
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.trust.displacement.view_fit import FittedView
from rgbd_calib.types import IntArray

_ROUNDS = 50
_HUBER_ROUNDS = 25
"""Huber's weights first, from any start, then Tukey's, which need a good one."""
_TUKEY = 4.7
"""Tukey's constant for 95 % efficiency with normal errors, in deviations."""
_CHI2_6_MEDIAN = 5.348
"""Median of chi squared with 6 degrees of freedom."""


@dataclass(frozen=True)
class LocatedCameras:
    """The cameras that the views join to the anchor."""

    cameras: tuple[str, ...]
    anchor: str
    before: dict[str, FloatArray]
    """T_world_color (4, 4) that the estimate started from."""
    T_world_color: dict[str, FloatArray]
    """(4, 4), the anchor's as it was."""
    covariance: FloatArray
    """(6 C, 6 C) of the left perturbations (rad, m) in the world; zeros for the anchor."""
    noise_factor: float
    """The views disagree by this many times the deviations assumed; the covariance counts it where above 1."""
    T_world_board: dict[str, FloatArray]
    """(4, 4) by frame, of frames that two joined cameras see."""
    misfit_sigmas: dict[tuple[str, str], float]
    """By (camera, frame): how far the view is from the others, in deviations for each degree of freedom."""
    shift_m: dict[tuple[str, str], float]
    """By (camera, frame): RMS distance over its corners from where the others put the board."""
    corners_m: dict[tuple[str, str], FloatArray]
    """By (camera, frame): the corners (n, 3) of the view, in the world."""


def locate_cameras(views: Sequence[FittedView], T_world_color: Mapping[str, FloatArray], anchor: str) -> LocatedCameras:
    """Poses of the cameras that common frames join to `anchor`, relative to it.

    Parameters
    ----------
    views : all of one rig; frames that only one camera sees add nothing.
    T_world_color : (4, 4) by camera, the start.
    """
    joined = joined_to(anchor, [(v.placed.view.camera, v.placed.view.frame) for v in views])
    cameras = tuple(name for name in T_world_color if name in joined)
    mine = [v for v in views if v.placed.view.camera in joined]
    counts: dict[str, int] = {}
    for v in mine:
        counts[v.placed.view.frame] = counts.get(v.placed.view.frame, 0) + 1
    mine = [v for v in mine if counts[v.placed.view.frame] > 1]
    frames = sorted({v.placed.view.frame for v in mine})
    cam = np.array([cameras.index(v.placed.view.camera) for v in mine], int)
    number = {name: f for f, name in enumerate(frames)}
    frame = np.array([number[v.placed.view.frame] for v in mine], int)
    T = np.stack([T_world_color[name] for name in cameras])
    boards = np.stack([np.eye(4)] * len(frames)) if frames else np.zeros((0, 4, 4))
    for v, c, f in zip(reversed(mine), cam[::-1], frame[::-1], strict=True):
        boards[f] = T[c] @ v.T_color_board
    weights, scale, covariance = np.ones(len(mine)), 1.0, np.zeros((6 * len(cameras), 6 * len(cameras)))
    distance = np.zeros(len(mine))
    free = np.repeat(np.array([name != anchor for name in cameras]), 6)
    pattern = _touched(cam, frame, len(frames), len(cameras))
    for round_ in range(_ROUNDS if mine else 0):
        y, info = _world(mine, T, boards, cam, frame)
        step, step_boards, covariance = _solve(pattern, y, info * weights[:, None, None], cam, frame, free)
        T, boards = se3.retract(T, step), se3.retract(boards, step_boards)
        y, info = _world(mine, T, boards, cam, frame)
        distance = np.sqrt(np.einsum("vi,vij,vj->v", y, info, y))
        rows, unknowns = 6 * len(mine), int(free.sum()) + 6 * len(frames)
        absorbed = rows / max(rows - unknowns, 1)
        scale = float(np.sqrt(np.median(distance**2) / _CHI2_6_MEDIAN * absorbed)) if rows > unknowns else 1.0
        relative = distance / np.sqrt(6 / absorbed) / max(scale, 1.0)
        new = _weights(relative, round_ < _HUBER_ROUNDS)
        settled = bool(np.all(np.abs(new - weights) < 1e-3)) and bool(np.all(np.abs(step) < 1e-7))
        weights = new
        if settled and round_ >= _HUBER_ROUNDS:
            break
    keys = [(v.placed.view.camera, v.placed.view.frame) for v in mine]
    shift = [_rms_shift(v, T[c] @ v.T_color_board, boards[f]) for v, c, f in zip(mine, cam, frame, strict=True)]
    corners = {key: se3.transform(boards[f], v.points_m) for key, v, f in zip(keys, mine, frame, strict=True)}
    return LocatedCameras(
        cameras,
        anchor,
        {name: T_world_color[name] for name in cameras},
        dict(zip(cameras, T, strict=True)),
        covariance * max(scale, 1.0) ** 2,
        scale,
        dict(zip(frames, boards, strict=True)),
        dict(zip(keys, (distance / np.sqrt(6)).tolist(), strict=True)),
        dict(zip(keys, shift, strict=True)),
        corners,
    )


def board_poses(T_world_color: Mapping[str, FloatArray], views: Sequence[FittedView]) -> dict[str, FloatArray]:
    """T_world_board (4, 4) by frame: the mean of what the views say through these poses, weighted by their information."""
    out: dict[str, FloatArray] = {}
    by_frame: dict[str, list[FittedView]] = {}
    for v in views:
        by_frame.setdefault(v.placed.view.frame, []).append(v)
    for frame in sorted(by_frame):
        mine = by_frame[frame]
        T = np.stack([T_world_color[v.placed.view.camera] for v in mine])
        mean = T[:1] @ mine[0].T_color_board
        y, info = _world(mine, T, mean, np.arange(len(mine)), np.zeros(len(mine), int))
        step = np.linalg.solve(info.sum(axis=0), np.einsum("vij,vj->i", info, y))
        out[frame] = se3.retract(mean[0], step)
    return out


def joined_to(anchor: str, seen: Sequence[tuple[str, str]]) -> set[str]:
    """Cameras that a chain of common frames joins to `anchor`; `seen` are (camera, frame)."""
    joined, grown = {anchor}, True
    while grown:
        frames = {frame for camera, frame in seen if camera in joined}
        more = {camera for camera, frame in seen if frame in frames} | joined
        grown, joined = more != joined, more
    return joined


def _world(
    views: Sequence[FittedView], T: FloatArray, boards: FloatArray, cam: IntArray, frame: IntArray
) -> tuple[FloatArray, FloatArray]:
    """y (v, 6) and its information (v, 6, 6), in the world."""
    W = T[cam] @ np.stack([v.T_color_board for v in views])
    y = se3.difference(W, boards[frame])
    Ad = np.stack([se3.adjoint(se3.inverse(T[c])) for c in cam])
    return y, np.einsum("vji,vjk,vkl->vil", Ad, np.stack([v.information for v in views]), Ad)


def _touched(cam: IntArray, frame: IntArray, n_frames: int, n_cameras: int) -> Pattern:
    """Which cameras see the board of each frame."""
    seen = [tuple(sorted(set(cam[frame == f].tolist()))) for f in range(n_frames)]
    columns = {key: (6 * np.array(key)[:, None] + np.arange(6)).ravel() for key in set(seen)}
    return Pattern.of(seen, columns, 6 * n_cameras, 6)


def _solve(
    pattern: Pattern, y: FloatArray, info: FloatArray, cam: IntArray, frame: IntArray, free: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Steps of cameras (C, 6) and boards (F, 6), and the cameras' covariance, boards eliminated."""
    values, vectors = np.linalg.eigh(info)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))[:, None]).transpose(0, 2, 1)[:, None]  # info = root' root
    r, nothing = root @ y[:, None, :, None], np.zeros((len(y), 1, 6, 0))
    equations = assemble(
        pattern,
        (
            Rows(
                frame[mine],
                6 * c + np.arange(6),
                root[mine],
                -root[mine],
                r[mine, ..., 0],
                np.zeros((len(mine), 1, 0), int),
                nothing[mine],
            )
            for c in range(pattern.n_globals // 6)
            if len(mine := np.flatnonzero(cam == c))
        ),
    )
    step = equations.step(free, 0.0)
    assert step is not None  # all cameras are joined, and every view poses its board
    return step[0].reshape(-1, 6), step[1], equations.covariance(free).of_globals


def _weights(relative: FloatArray, huber: bool) -> FloatArray:
    if huber:
        weights: FloatArray = np.minimum(1.0, 1.5 / np.maximum(relative, 1e-12))
        return weights
    # never all of a frame: a view of weight 1e-6 adds nothing, and the equations stay regular
    return np.asarray(np.maximum(np.clip(1 - (relative / _TUKEY) ** 2, 0, 1) ** 2, 1e-6), np.float64)


def _rms_shift(view: FittedView, T_world_board: FloatArray, T_by_all: FloatArray) -> float:
    d = se3.transform(T_world_board, view.points_m) - se3.transform(T_by_all, view.points_m)
    return float(np.sqrt(np.mean(np.sum(d**2, axis=1))))

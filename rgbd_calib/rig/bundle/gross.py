"""Gross errors of the bundle: which views and corners are dropped, by which rule.

After each solution, for every view: its RMS off the pose part, and the size of its pose part, for pixels and for depth,
each in sigmas. A view's pixels go where one of them exceeds `max_view_ratio` times the median of all views of that kind,
and its depth goes likewise; of the views of one frame only the worst goes at a time, since the others may just be
pulled by it. A single depth goes beyond `max_sigmas`. Then the bundle is solved again, until nothing is dropped. What
then fits after all, within half of the limits, was pulled by another view and is taken back, once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.bundle import model, solve, variance
from rgbd_calib.rig.bundle.model import Observations, State
from rgbd_calib.rig.bundle.solve import Weights
from rgbd_calib.types import Board, IntArray


@dataclass(frozen=True)
class Dropped:
    """Masks of what stays, and what went in this pass, by view."""

    has_pixel: IntArray
    has_depth: IntArray
    pixel_views: dict[int, str]
    depth_views: dict[int, str]
    depth_corners: int


def find(
    state: State, obs: Observations, board: Board, weights: Weights, max_view_ratio: float, max_sigmas: float
) -> Dropped:
    """What to drop at a solution, at which `weights` were updated."""
    sizes = _sizes(state, obs, board, weights, (weights.Q_pixel, weights.Q_depth))
    n2, n3 = (np.asarray(mask.any(axis=1)) for mask in (obs.has_pixel, obs.has_depth))
    bad_pixel = _beyond(sizes.off_pixel, n2, obs, max_view_ratio, "RMS of its corners", in_frame=False)
    bad_pixel |= _beyond(sizes.pose_pixel, n2 & obs.shared, obs, max_view_ratio, "shift against the other cameras")
    bad_depth = _beyond(sizes.off_depth, n3, obs, max_view_ratio, "scatter of its depth", in_frame=False)
    bad_depth |= _beyond(sizes.pose_depth, n3, obs, max_view_ratio, "offset of its depth")
    bad_depth = {v: why for v, why in bad_depth.items() if v not in bad_pixel}

    corner = np.abs(sizes.corner_depth) > max_sigmas
    has_pixel, has_depth = obs.has_pixel.copy(), obs.has_depth & ~corner
    has_pixel[list(bad_pixel)] = False
    has_depth[[*bad_pixel, *bad_depth]] = False
    kept = np.ones(len(obs.camera), bool)
    kept[[*bad_pixel, *bad_depth]] = False
    return Dropped(has_pixel, has_depth, bad_pixel, bad_depth, int((corner & obs.has_depth)[kept].sum()))


def take_back(
    state: State,
    used: Observations,
    everything: Observations,
    board: Board,
    weights: Weights,
    max_view_ratio: float,
    max_sigmas: float,
) -> tuple[Observations, list[int]]:
    """Observations with the dropped views that fit after all, and which views those are."""
    sigma3 = solve.depth_sigma(everything, weights.k_depth, weights.cell_exponent)
    now = _sizes(state, used, board, weights, (weights.Q_pixel, weights.Q_depth))
    sizes = _sizes(state, everything, board, weights, variance.pose_parts(state, everything, board, sigma3))
    kept2, kept3 = (np.asarray(mask.any(axis=1)) for mask in (used.has_pixel, used.has_depth))
    anchored = np.isin(used.frame, used.frame[kept2])  # the board is still posed by another view
    limit = max_view_ratio / 2
    fits2 = _below(sizes.off_pixel, now.off_pixel[kept2], limit) & _below(
        sizes.pose_pixel, now.pose_pixel[kept2 & used.shared], limit
    )
    fits3 = _below(sizes.off_depth, now.off_depth[kept3], limit) & _below(
        sizes.pose_depth, now.pose_depth[kept3], limit
    )
    back2 = ~kept2 & anchored & fits2 & everything.has_pixel.any(axis=1)
    back3 = ~kept3 & (kept2 | back2) & fits3 & everything.has_depth.any(axis=1)
    has_pixel, has_depth = used.has_pixel.copy(), used.has_depth.copy()
    has_pixel[back2] = everything.has_pixel[back2]
    has_depth[back3] = everything.has_depth[back3] & (np.abs(sizes.corner_depth[back3]) <= max_sigmas)
    # a view comes back whole, or, where only its depth had gone, with its depth
    whole = back2 & (back3 | ~everything.has_depth.any(axis=1))
    return used.keep(has_pixel, has_depth), [int(v) for v in np.flatnonzero(whole | (back3 & kept2))]


@dataclass(frozen=True)
class _Sizes:
    """How large each view's residuals are, in sigmas, (V,) each, and single depths (V, N) off the pose part."""

    off_pixel: FloatArray
    pose_pixel: FloatArray
    off_depth: FloatArray
    pose_depth: FloatArray
    corner_depth: FloatArray


def _sizes(
    state: State, obs: Observations, board: Board, weights: Weights, pose_parts: tuple[FloatArray, FloatArray]
) -> _Sizes:
    pixel, depth = model.residuals(state, obs, board)
    sigma3 = solve.depth_sigma(obs, weights.k_depth, weights.cell_exponent)
    Q_pixel, Q_depth = pose_parts
    r2 = (pixel / weights.sigma_2d_px[obs.camera, None, None]).reshape(len(obs.camera), -1)
    off2, pose2 = _split(r2, Q_pixel)
    off3, pose3 = _split(depth / sigma3, Q_depth)
    n2, n3 = 2 * obs.has_pixel.sum(axis=1), obs.has_depth.sum(axis=1)
    return _Sizes(_rms(off2, n2), _rms(pose2, n2), _rms(off3, n3), _rms(pose3, n3), off3)


def _below(size: FloatArray, kept: FloatArray, ratio: float) -> IntArray:
    return np.asarray(size <= ratio * (float(np.median(kept)) if len(kept) else 0.0))


def _split(r: FloatArray, Q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Off the pose part (V, n), and the part itself in Q's coordinates (V, d)."""
    pose = np.einsum("vnd,vn->vd", Q, r)
    return r - np.einsum("vnd,vd->vn", Q, pose), pose


def _rms(r: FloatArray, n: IntArray) -> FloatArray:
    return np.sqrt(np.sum(r**2, axis=1) / np.maximum(n, 1))


def _beyond(
    size: FloatArray, counted: IntArray, obs: Observations, ratio: float, what: str, in_frame: bool = True
) -> dict[int, str]:
    """Views whose `size` is more than `ratio` medians; with `in_frame`, only the worst of each frame."""
    if not counted.any():
        return {}
    median = float(np.median(size[counted]))
    bad = {}
    for v in np.flatnonzero(counted & (size > ratio * max(median, 1e-9))):
        if not in_frame or size[v] == size[counted & (obs.frame == obs.frame[v])].max():
            bad[int(v)] = f"{what} is {size[v] / median:.1f} times the median, {ratio:g} allowed"
    return bad

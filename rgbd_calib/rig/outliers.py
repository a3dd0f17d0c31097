"""Outliers of the bundle: which views and corners are dropped, by which rule.

After each solution, for every view: its RMS off the pose part, and the size of its pose part, for pixels and for depth,
each in sigmas. A view's pixels go where one of them exceeds `max_view_ratio` times what is usual: the median of all views
of that kind, or of its own camera's where that is larger (a dim or blurred camera is noisier as a whole). Corners that
scatter more shift the whole view by as much more: a pose part is compared with what is usual at the view's own scatter. Its
depth goes likewise; of the views of one frame only the worst goes at a time, since the others may just be pulled by it. A single depth goes beyond `max_sigmas`. Then the bundle is solved again, until nothing is dropped. What
then fits after all, within half of the limits, was pulled by another view and is taken back, once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.linear import BoolArray, IntArray
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.observations import Observations
from rgbd_calib.rig.problem import Problem, State
from rgbd_calib.rig.reweight import pose_parts
from rgbd_calib.rig.weights import split

MIN_VIEWS = 5
"""Views, of all cameras or of one, from which on their median says what is usual."""
MOST_NOISIER = 3.0
"""By how much a camera may be noisier than all together, or a view than its camera's; beyond it, views are wrong and not
noisy."""


@dataclass(frozen=True)
class Dropped:
    """Masks of what stays, and what went in this pass, by view."""

    obs: Observations
    pixel_views: dict[int, str]
    depth_views: dict[int, str]
    depth_corners: int


def find(problem: Problem, state: State) -> Dropped:
    """What to drop at a solution, at which the weights were updated."""
    obs, ratio = problem.obs, problem.setup.params.max_view_ratio
    sizes = _sizes(problem, state, obs, (problem.weights.Q_pixel, problem.weights.Q_depth))
    n2, n3 = (np.asarray(mask.any(axis=1)) for mask in (obs.has_pixel, obs.has_depth))
    usual = _usual_sizes(sizes, n2, n3, obs, sizes)
    bad_pixel = _beyond(sizes.off_pixel, usual.off_pixel, n2, obs, ratio, "RMS of its corners", in_frame=False)
    shared = n2 & obs.shared
    bad_pixel |= _beyond(sizes.pose_pixel, usual.pose_pixel, shared, obs, ratio, "shift against the other cameras")
    bad_depth = _beyond(sizes.off_depth, usual.off_depth, n3, obs, ratio, "scatter of its depth", in_frame=False)
    bad_depth |= _beyond(sizes.pose_depth, usual.pose_depth, n3, obs, ratio, "offset of its depth")
    bad_depth = {v: why for v, why in bad_depth.items() if v not in bad_pixel}

    corner = np.abs(sizes.corner_depth) > problem.setup.params.max_depth_sigmas
    has_pixel, has_depth = obs.has_pixel.copy(), obs.has_depth & ~corner
    has_pixel[list(bad_pixel)] = False
    has_depth[[*bad_pixel, *bad_depth]] = False
    kept = np.ones(len(obs.camera), bool)
    kept[[*bad_pixel, *bad_depth]] = False
    n_corners = int((corner & obs.has_depth)[kept].sum())
    return Dropped(obs.keep(has_pixel, has_depth), bad_pixel, bad_depth, n_corners)


def take_back(problem: Problem, state: State) -> tuple[Observations, list[int]]:
    """Observations with the dropped views that fit after all, and which views those are."""
    used, everything, weights = problem.obs, problem.setup.obs, problem.weights
    now = _sizes(problem, state, used, (weights.Q_pixel, weights.Q_depth))
    Q = pose_parts(problem, state, weights.depth_sigma_m(everything), everything)
    sizes = _sizes(problem, state, everything, Q)
    kept2, kept3 = (np.asarray(mask.any(axis=1)) for mask in (used.has_pixel, used.has_depth))
    anchored = np.isin(used.frame, used.frame[kept2])  # the board is still posed by another view
    limit = problem.setup.params.max_view_ratio / 2
    usual = _usual_sizes(now, kept2, kept3, used, sizes)
    fits2 = (sizes.off_pixel <= limit * usual.off_pixel) & (sizes.pose_pixel <= limit * usual.pose_pixel)
    fits3 = (sizes.off_depth <= limit * usual.off_depth) & (sizes.pose_depth <= limit * usual.pose_depth)
    back2 = ~kept2 & anchored & fits2 & everything.has_pixel.any(axis=1)
    back3 = ~kept3 & (kept2 | back2) & fits3 & everything.has_depth.any(axis=1)
    has_pixel, has_depth = used.has_pixel.copy(), used.has_depth.copy()
    has_pixel[back2] = everything.has_pixel[back2]
    near = np.abs(sizes.corner_depth[back3]) <= problem.setup.params.max_depth_sigmas
    has_depth[back3] = everything.has_depth[back3] & near
    # a view comes back whole, or, where only its depth had gone, with its depth
    whole = back2 & (back3 | ~everything.has_depth.any(axis=1))
    return used.keep(has_pixel, has_depth), [int(v) for v in np.flatnonzero(whole | (back3 & kept2))]


@dataclass(frozen=True)
class _ViewSizes:
    """Of each view (V,), in sigmas: RMS off the pose part, and the pose part's."""

    off_pixel: FloatArray
    pose_pixel: FloatArray
    off_depth: FloatArray
    pose_depth: FloatArray


@dataclass(frozen=True)
class _Sizes(_ViewSizes):
    """How large each view's residuals are, and single depths (V, N) off the pose part."""

    corner_depth: FloatArray


def _sizes(problem: Problem, state: State, obs: Observations, Q: tuple[FloatArray, FloatArray]) -> _Sizes:
    pixel, depth = problem.residuals(state, obs)
    r2 = (pixel / problem.weights.sigma_2d_px[obs.camera, None, None]).reshape(len(obs.camera), -1)
    off2, pose2 = split(r2, Q[0])
    off3, pose3 = split(depth / problem.weights.depth_sigma_m(obs), Q[1])
    n2, n3 = 2 * obs.has_pixel.sum(axis=1), obs.has_depth.sum(axis=1)
    return _Sizes(_rms(off2, n2), _rms(pose2, n2), _rms(off3, n3), _rms(pose3, n3), off3)


def _usual_sizes(now: _ViewSizes, n2: BoolArray, n3: BoolArray, obs: Observations, of: _ViewSizes) -> _ViewSizes:
    """What is usual, by the views `now` that count, for views of these sizes."""
    off2, off3 = _usual(now.off_pixel, n2, obs), _usual(now.off_depth, n3, obs)
    pose2, pose3 = _usual(now.pose_pixel, n2 & obs.shared, obs), _usual(now.pose_depth, n3, obs)
    noisier2, noisier3 = (
        np.clip(own / np.maximum(off, 1e-9), 1.0, MOST_NOISIER)
        for own, off in ((of.off_pixel, off2), (of.off_depth, off3))
    )
    return _ViewSizes(off2, pose2 * noisier2, off3, pose3 * noisier3)


def _usual(size: FloatArray, counted: BoolArray, obs: Observations) -> FloatArray:
    """What is usual for each view (V,); inf where too few views tell."""
    pooled = float(np.median(size[counted])) if counted.sum() >= MIN_VIEWS else np.inf
    out = np.full(len(size), pooled)
    for c in np.unique(obs.camera):
        mine = obs.camera == c
        if (own := size[counted & mine]).size >= MIN_VIEWS:
            out[mine] = np.clip(float(np.median(own)), pooled, MOST_NOISIER * pooled)
    return out


def _rms(r: FloatArray, n: IntArray) -> FloatArray:
    return np.asarray(np.sqrt(np.sum(r**2, axis=1) / np.maximum(n, 1)))


def _beyond(
    size: FloatArray,
    usual: FloatArray,
    counted: BoolArray,
    obs: Observations,
    ratio: float,
    what: str,
    in_frame: bool = True,
) -> dict[int, str]:
    """Views whose `size` is more than `ratio` times what is usual; with `in_frame`, only the worst of each frame."""
    relative = size / np.maximum(usual, 1e-9)
    bad = {}
    for v in np.flatnonzero(counted & (relative > ratio)):
        if not in_frame or relative[v] == relative[counted & (obs.frame == obs.frame[v])].max():
            bad[int(v)] = f"{what} is {relative[v]:.1f} times the usual, {ratio:g} allowed"
    return bad

"""Gross errors of the bundle: which views and corners are dropped, by which rule.

After each solution, for every view: its RMS off the pose part, and the size of its pose part, for pixels and for depth,
each in sigmas. A view's pixels go where one of them exceeds `max_view_ratio` times the median of all views of that kind,
and its depth goes likewise; of the views of one frame only the worst goes at a time, since the others may just be
pulled by it. A single depth goes beyond `max_sigmas`. Then the bundle is solved again, until nothing is dropped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.stages.bundle import model
from rgbd_calib.stages.bundle.model import Observations, State
from rgbd_calib.stages.bundle.solve import Weights
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
    """What to drop at a solution."""
    pixel, depth = model.residuals(state, obs, board)
    V = len(obs.camera)
    r2 = (pixel / weights.sigma_2d_px[obs.camera, None, None]).reshape(V, -1)
    r3 = depth / weights.k_depth[obs.camera, None]
    off2, pose2 = _split(r2, weights.Q_pixel)
    off3, pose3 = _split(r3, weights.Q_depth)
    n2, n3 = 2 * obs.has_pixel.sum(axis=1), obs.has_depth.sum(axis=1)
    bad_pixel = _beyond(_rms(off2, n2), n2 > 0, obs, max_view_ratio, "RMS of its corners", in_frame=False)
    bad_pixel |= _beyond(_rms(pose2, n2), (n2 > 0) & obs.shared, obs, max_view_ratio, "shift against the other cameras")
    bad_depth = _beyond(_rms(off3, n3), n3 > 0, obs, max_view_ratio, "scatter of its depth", in_frame=False)
    bad_depth |= _beyond(_rms(pose3, n3), n3 > 0, obs, max_view_ratio, "offset of its depth")
    bad_depth = {v: why for v, why in bad_depth.items() if v not in bad_pixel}

    corner = np.abs(off3) > max_sigmas
    has_pixel, has_depth = obs.has_pixel.copy(), obs.has_depth & ~corner
    has_pixel[list(bad_pixel)] = False
    has_depth[[*bad_pixel, *bad_depth]] = False
    kept = np.ones(V, bool)
    kept[[*bad_pixel, *bad_depth]] = False
    return Dropped(has_pixel, has_depth, bad_pixel, bad_depth, int((corner & obs.has_depth)[kept].sum()))


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

"""The bundle's equations, with columns for the errors that its model does not have, for the self-checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.polynomial import legendre

from rgbd_calib.geometry.camera import N_INTRINSICS, Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.bundle import BundleResult, model, solve
from rgbd_calib.rig.bundle.model import N_BOW, Observations
from rgbd_calib.trust.self_check import NO_MOMENT, Equations
from rgbd_calib.types import Board, IntArray

MAX_VIEWS = 800
"""Of more views, every second, third, ... frame is checked: the equations of 800 take some 100 MB."""
VIEWS_AT_ONCE = 100
PIXEL_DEGREE, DEPTH_DEGREE, RANGE_DEGREE, SHAPE_DEGREE = 4, 3, 5, 4
"""Of polynomials over the image, the depth range and the board. The lens has five coefficients up to the fifth power, of
which the fourth degree catches what they miss; a depth sensor's field is smoother (a tilt, a bowl, an S)."""


POSE_PARTS = np.concatenate([solve.PIXEL_PARTS, solve.PIXEL_PARTS.max() + 1 + solve.DEPTH_PARTS])
"""What is alike in the pose part of a view, in the pixels and in the depth."""


def equations_of(solved: BundleResult, board: Board, moments: Sequence[str]) -> Equations:
    """Equations at the solution; `moments` are the recording's frames in order of time, others are of a camera alone."""
    obs, kept = solved.obs, _thinned(solved)
    cameras, frames = obs.camera[kept], np.unique(obs.frame[kept], return_inverse=True)[1]
    at = {name: k for k, name in enumerate(moments)}
    of_frame = np.array([at.get(name, NO_MOMENT) for name in solved.frames])
    index = solve.columns(solved.state, cameras)
    local = _names(solved.state.n_camera)
    products = [
        _products(solved, board, kept[i : i + VIEWS_AT_ONCE], local) for i in range(0, len(kept), VIEWS_AT_ONCE)
    ]
    gram, score, low, size, low_score = (np.concatenate([part[k] for part in products]) for k in range(5))
    z_m = model.points_in_color(solved.state, obs.only(kept), board)[1][..., 2]
    seen = obs.has_pixel[kept]
    eq = Equations(
        solved.cameras,
        cameras,
        frames,
        of_frame[obs.frame[kept]],
        obs.shared[kept],
        tuple(moments),
        local,
        np.arange(index.shape[1]),
        index,
        np.ones(index.shape, bool),
        gram,
        score,
        low,
        low_score,
        POSE_PARTS,
        np.zeros(len(POSE_PARTS)),
        size,
        seen.sum(axis=1),
        np.where(seen, z_m, 0.0).sum(axis=1) / np.maximum(seen.sum(axis=1), 1),
        solved.prior.information,
        solved.prior.information @ (solve.values(solved.state) - solved.prior.mean),
        solved.prior.free,
    )
    return eq.weighed()


def _thinned(solved: BundleResult) -> IntArray:
    """Views with pixels, of every frame or of every n-th."""
    obs = solved.obs
    views = np.flatnonzero(obs.has_pixel.any(axis=1))
    every = -(-len(views) // MAX_VIEWS)
    if every == 1:
        return views
    shared = np.unique(obs.frame[views][obs.shared[views]])[::every]
    alone = np.unique(obs.frame[views][~obs.shared[views]])[::every]
    return views[np.isin(obs.frame[views], np.concatenate([shared, alone]))]


def _names(n_camera: int) -> Mapping[str, slice]:
    sizes = {
        "pose": 6,
        "lens": N_INTRINSICS,
        "bias": n_camera - 6 - N_INTRINSICS,
        "bow": N_BOW,
        "board": 6,
        "registration": 2,
        "pixel_field": 2 * _n_terms(PIXEL_DEGREE),
        "depth_field": _n_terms(DEPTH_DEGREE) - 1,
        "range": RANGE_DEGREE - 1,
        "scale": 1,
        "stretch": 2,
        "thickness": 1,
        "shape": sum(d + 1 for d in range(3, SHAPE_DEGREE + 1)),
    }
    stops = np.cumsum(list(sizes.values()))
    return {name: slice(int(stop) - n, int(stop)) for (name, n), stop in zip(sizes.items(), stops, strict=True)}


def _products(
    solved: BundleResult, board: Board, views: IntArray, local: Mapping[str, slice]
) -> tuple[FloatArray, ...]:
    """Gram matrices, scores, pose parts and sizes of some views, and the pose parts of their residuals."""
    obs, state, weights = solved.obs.only(views), solved.state, solved.weights
    lin = model.linearize(state, obs, board)
    V, N, _, G0 = lin.J.shape
    A = np.zeros((V, N, 3, max(part.stop for part in local.values())))
    A[..., :G0] = lin.J
    _scale_noise(A[:, :, 2, local["bias"]], lin.residual[..., 2], obs)
    p = model.points_in_color(state, obs, board)[1]
    lenses = [solved.priors[name].intrinsics for name in solved.cameras]
    by_z = (obs.has_depth / obs.depth_m**2)[..., None]  # rows of depth are over z^2
    A[:, :, 2, local["registration"]] = _slopes(p, state.intrinsics[obs.camera]) * by_z
    u, v = _in_image(obs, lenses)
    fields = _terms(u, v, 0, PIXEL_DEGREE) * obs.has_pixel[..., None]
    n = fields.shape[-1]
    A[:, :, 0, local["pixel_field"]][..., :n] = fields
    A[:, :, 1, local["pixel_field"]][..., n:] = fields
    A[:, :, 2, local["depth_field"]] = -_terms(u, v, 1, DEPTH_DEGREE) * obs.depth_m[..., None] * by_z
    A[:, :, 2, local["range"]] = -_range_terms(obs, solved.bias_range_m) * by_z
    _board_columns(A, lin.J[..., -3:], state.T_parent_board[obs.frame][:, :3, :3], obs.points_m, board, local)

    some = replace(weights, robust_pixel=weights.robust_pixel[views], robust_depth=weights.robust_depth[views])
    w_pixel, w_depth = solve.scales(obs, some)
    w = np.stack([w_pixel, w_pixel, w_depth], axis=-1)
    rows, r = A * w[..., None], lin.residual * w
    flat = rows.reshape(V, 3 * N, -1)
    Q_pixel, Q_depth = weights.Q_pixel[views], weights.Q_depth[views]
    in_pixel = Q_pixel.transpose(0, 2, 1) @ rows[:, :, :2].reshape(V, 2 * N, -1)
    in_depth = Q_depth.transpose(0, 2, 1) @ rows[:, :, 2]
    of_pixel = np.einsum("vnd,vn->vd", Q_pixel, r[:, :, :2].reshape(V, 2 * N))
    of_depth = np.einsum("vnd,vn->vd", Q_depth, r[:, :, 2])
    f = state.intrinsics[obs.camera][:, None, :2]
    m = np.concatenate([p[..., 2:] / f, obs.depth_m[..., None] ** 2], axis=-1)
    in_m = (A * m[..., None]).reshape(V, 3 * N, -1)
    return (
        flat.transpose(0, 2, 1) @ flat,
        (r.reshape(V, 1, -1) @ flat)[:, 0],
        np.concatenate([in_pixel, in_depth], axis=1),
        in_m.transpose(0, 2, 1) @ in_m,
        np.concatenate([of_pixel, of_depth], axis=1),
    )


def _scale_noise(by_bias: FloatArray, residual: FloatArray, obs: Observations) -> None:
    """Adds to the derivatives by the bias what it does to the noise: corrected depth is scaled, and its noise with it.

    A residual r (p_z - z - bias(z)) is to be judged in sigmas (1 + bias'(z)) k z^2. Against pixels that is nothing; but a
    board, a rig and a depth that all shrink together would gain by less noise alone, 1 for each depth and unit of scale.
    """
    for j in range(1, by_bias.shape[-1]):
        by_bias[..., j] -= residual * j * obs.powers[..., j - 1]


def _slopes(p: FloatArray, vectors: FloatArray) -> FloatArray:
    """(V, N, 2), -dz/du and -dz/dv of the board's plane in the image, metres a pixel, by a plane through its corners.

    On a plane n.p = d, z = d / (n . ray), so that dz/du = -z n_x / (f_x n . ray): what a depth image that is shifted by a
    pixel against the colour image changes.
    """
    q = p - p.mean(axis=1, keepdims=True)
    n = np.linalg.svd(q, full_matrices=False)[2][:, -1]
    along = np.einsum("vi,vni->vn", n, p / p[..., 2:])
    safe = np.where(np.abs(along) > 0.05, along, np.inf)  # edge on there is no slope
    slope: FloatArray = -p[..., 2:] * n[:, None, :2] / vectors[:, None, :2] / safe[..., None]
    return -slope


def _in_image(obs: Observations, lenses: Sequence[Intrinsics]) -> tuple[FloatArray, FloatArray]:
    """Pixels from -1 to 1 over the image."""
    size = np.array([(lens.width, lens.height) for lens in lenses], float)[obs.camera][:, None]
    at = np.clip(2 * obs.pixels_px / size - 1, -1, 1)
    return at[..., 0], at[..., 1]


def _n_terms(degree: int) -> int:
    return (degree + 1) * (degree + 2) // 2


def _terms(x: FloatArray, y: FloatArray, lowest: int, highest: int) -> FloatArray:
    """Products of Legendre polynomials in x and y with a total degree from `lowest` to `highest`, last axis."""
    X, Y = legendre.legvander(x, highest), legendre.legvander(y, highest)
    pairs = [(i, d - i) for d in range(lowest, highest + 1) for i in range(d + 1)]
    return np.stack([X[..., i] * Y[..., j] for i, j in pairs], axis=-1)


def _range_terms(obs: Observations, bias_range_m: FloatArray) -> FloatArray:
    """(V, N, RANGE_DEGREE - 1), metres times z: Legendre polynomials of degree 2, ... over the camera's depths."""
    t = np.zeros(obs.depth_m.shape)
    for c in np.unique(obs.camera):
        mine = obs.has_depth & (obs.camera == c)[:, None]
        if mine.any():
            low, high = obs.depth_m[mine].min(), obs.depth_m[mine].max()
            t[mine] = 2 * (obs.depth_m[mine] - low) / max(high - low, 1e-6) - 1
    return legendre.legvander(t, RANGE_DEGREE)[..., 2:] * obs.depth_m[..., None]


def _board_columns(
    A: FloatArray,
    by_parent: FloatArray,
    R_parent_board: FloatArray,
    X: FloatArray,
    board: Board,
    local: Mapping[str, slice],
) -> None:
    """Fills in what another board would change: `by_parent` (V, N, 3, 3) is by a shift of its points in the parent."""
    by_point = by_parent @ R_parent_board[:, None]
    x, y, z = np.moveaxis(X, -1, 0)
    half = np.array([(board.cols - 1) * board.square_m, (board.rows - 1) * board.square_m]) / 2
    zero = np.zeros_like(x)

    def columns(shifts: Sequence[tuple[FloatArray, FloatArray, FloatArray]]) -> FloatArray:
        return np.stack([np.einsum("vnij,vnj->vni", by_point, np.stack(s, axis=-1)) for s in shifts], axis=-1)

    A[..., local["scale"]] = columns([(x, y, z)])
    A[..., local["stretch"]] = columns([(x, -y, zero), (y, x, zero)])
    A[..., local["thickness"]] = columns([(zero, zero, (z > 0).astype(float))])
    bent = _terms(x / half[0] - 1, y / half[1] - 1, 3, SHAPE_DEGREE)
    A[..., local["shape"]] = columns([(zero, zero, bent[..., k]) for k in range(bent.shape[-1])])

"""Weights of the bundle: variance components of pixels and depth, robust weights, and the pose part of each view.

Helmert's and Forstner's estimate of a variance from the residuals of its group: sigma^2 = sum r^2 / redundancy, with
redundancy = residuals - tr(J Cov J'), what the fit absorbed. Groups: the pixels of each camera, off the pose part; the
depth of each camera, off it; and the kinds of pose part of all views together (their ratio to the rest, at least 1): a
finder that draws whole boards to one side shifts them, and does not turn them. How the depth's variance falls with the size
of a corner's cell is one exponent for all cameras.

Depth comes in whole units, and neighbouring pixels of a board round alike: averaging a cell's pixels lowers their noise, not
the rounding. So unit^2 / 12 is added to a corner's variance, in the weight of its whole view; that tells near the camera,
where the noise is a fraction of the unit.
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.bundle import model, solve
from rgbd_calib.rig.bundle.model import Observations, State
from rgbd_calib.rig.bundle.solve import Prior, Weights
from rgbd_calib.types import Board, IntArray

MIN_CELL_SPREAD = 0.01
"""Least variance of the logarithm of the cells' sizes that tells how noise falls with them."""
MIN_REDUNDANCY = 10.0
"""A group with less takes the variance of all cameras together."""


def initial(obs: Observations, n_cameras: int, sigma_2d_px: float, k_depth: float) -> Weights:
    """Equal weights, no pose part."""
    V, N = obs.has_pixel.shape
    one = np.ones((V, N))
    return Weights(
        np.full(n_cameras, sigma_2d_px),
        np.full(n_cameras, k_depth),
        0.0,
        np.ones(6),
        np.ones(3),
        one,
        one,
        np.zeros((V, 2 * N, 6)),
        np.zeros((V, N, 3)),
    )


def update(state: State, obs: Observations, board: Board, weights: Weights, prior: Prior, huber: float) -> Weights:
    """The weights that the residuals at `state` give, from its equations under the present ones.

    Raises
    ------
    CalibrationError
        The equations are singular.
    """
    cov = solve.covariance(solve.build(state, obs, board, weights, prior), prior.free)
    traces = solve.view_traces(cov, state, obs, board, weights)
    squares = solve.sums_of_squares(state, obs, board, weights)
    dims2, dims3 = (np.sum(Q**2, axis=1) for Q in (weights.Q_pixel, weights.Q_depth))
    n3 = np.maximum(obs.has_depth.sum(axis=1), 1)
    sum3 = np.sum(weights.robust_depth * obs.has_depth, axis=1)
    rows = np.empty((solve.N_PARTS, len(obs.camera)))
    rows[solve.OFF_PIXEL] = 2 * np.sum(weights.robust_pixel * obs.has_pixel, axis=1) - dims2.sum(axis=1)
    rows[solve.OFF_DEPTH] = sum3 * (1 - dims3.sum(axis=1) / n3)
    rows[solve.IN_PIXEL], rows[solve.IN_DEPTH] = dims2.T, dims3.T
    redundancy = rows - traces
    factor2, factor3 = (
        _by_camera(squares[part], redundancy[part], obs.camera, len(sigma))
        for part, sigma in ((solve.OFF_PIXEL, weights.sigma_2d_px), (solve.OFF_DEPTH, weights.k_depth))
    )
    ratio2, ratio3 = (
        _ratios(squares[part] / factor[obs.camera], redundancy[part], kinds)
        for part, factor, kinds in (
            (solve.IN_PIXEL, factor2, solve.PIXEL_PARTS),
            (solve.IN_DEPTH, factor3, solve.DEPTH_PARTS),
        )
    )
    sigma_2d_px, k_depth = weights.sigma_2d_px * np.sqrt(factor2), weights.k_depth * np.sqrt(factor3)
    pixel, depth = model.residuals(state, obs, board)
    sigma3 = solve.depth_sigma(obs, k_depth, weights.cell_exponent)
    Q_pixel, Q_depth = pose_parts(state, obs, board, sigma3)
    off3 = _off_pose((depth / sigma3)[..., None], Q_depth)
    exponent = np.clip(weights.cell_exponent + _cell_slope(off3[..., 0], obs), 0.0, 1.0)
    robust_pixel = _huber(_off_pose(pixel, Q_pixel) / sigma_2d_px[obs.camera, None, None], huber)
    noise3_m2 = np.mean(ratio3**2) * np.sum((sigma3 * obs.depth_m**2) ** 2 * obs.has_depth, axis=1) / n3
    rounding = noise3_m2 / np.maximum(noise3_m2 + obs.rounding_m**2, 1e-30)
    robust_depth = _huber(off3, huber) * rounding[:, None]
    return Weights(sigma_2d_px, k_depth, float(exponent), ratio2, ratio3, robust_pixel, robust_depth, Q_pixel, Q_depth)


def _cell_slope(r_sigma: FloatArray, obs: Observations) -> float:
    """How much faster the variance falls with a cell's size than its weight says, as an exponent.

    Slope of log r^2 over log size, about each camera's own means; the logarithm keeps gross errors from counting.
    """
    used = obs.has_depth & (np.abs(r_sigma) > 1e-9)
    x, y = np.log(obs.cell_ratio[used]), np.log(r_sigma[used] ** 2)
    camera = np.broadcast_to(obs.camera[:, None], used.shape)[used]
    count = np.maximum(np.bincount(camera), 1)
    x, y = (v - (np.bincount(camera, v) / count)[camera] for v in (x, y))
    spread = float(x @ x)
    return -float(x @ y) / spread if spread > MIN_CELL_SPREAD * len(x) else 0.0


def change(a: Weights, b: Weights) -> float:
    """Largest relative difference of any sigma or ratio."""
    if abs(a.cell_exponent - b.cell_exponent) > 0.1:
        return 1.0
    names = "sigma_2d_px", "k_depth", "ratio_pixel", "ratio_depth"
    return max(float(np.max(np.abs(np.log(getattr(a, name) / getattr(b, name))))) for name in names)


def _by_camera(squares: FloatArray, redundancy: FloatArray, camera: FloatArray, n: int) -> FloatArray:
    """Variance factor of each camera (n,); the pooled one where a camera has too little redundancy."""
    total, left = (np.bincount(camera, x, minlength=n) for x in (squares, redundancy))
    pooled = total.sum() / left.sum() if left.sum() > MIN_REDUNDANCY else 1.0
    factor = np.where(left > MIN_REDUNDANCY, total / np.maximum(left, 1e-9), pooled)
    return np.maximum(factor, 1e-12)


def _ratios(squares: FloatArray, redundancy: FloatArray, kinds: IntArray) -> FloatArray:
    """The pose part's standard deviation over the rest's, (d,), of squares (d, V), at least 1; that of all where a kind has
    too little redundancy."""
    total, left = (np.bincount(kinds, x.sum(axis=1)) for x in (squares, redundancy))
    pooled = total.sum() / left.sum() if left.sum() > MIN_REDUNDANCY else 1.0
    own = np.where(left > MIN_REDUNDANCY, total / np.maximum(left, 1e-9), pooled)
    return np.sqrt(np.maximum(own, 1.0))[kinds]


def pose_parts(state: State, obs: Observations, board: Board, depth_sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Orthonormal bases of what a change of the board's pose does to a view's pixels (V, 2 N, 6), its shifts along the
    camera's axes first, and to its depth (V, N, 3), its offset first, in sigmas."""
    V = len(obs.camera)
    J2 = np.concatenate(
        [
            model.linearize(state, obs.only(views), board).by_pose[:, :, :2]
            for views in (slice(v, v + solve.VIEWS_AT_ONCE) for v in range(0, V, solve.VIEWS_AT_ONCE))
        ]
    ).reshape(V, -1, 6)
    R_parent_color = model.color_parent(state, obs)[:, :3, :3].transpose(0, 2, 1)
    flat = np.stack([obs.has_depth, *(obs.points_m[..., k] * obs.has_depth for k in (0, 1))], axis=-1)
    flat = flat / (depth_sigma * obs.depth_m**2)[..., None]
    return _in_order(_orthonormal(J2), J2[..., 3:] @ R_parent_color), _in_order(_orthonormal(flat), flat)


def _in_order(Q: FloatArray, first: FloatArray) -> FloatArray:
    """The same spaces with bases that begin with the columns of `first`, (V, n, k), one after the other."""
    turned, _ = np.linalg.qr(Q.transpose(0, 2, 1) @ first, mode="complete")
    return Q @ turned


def _orthonormal(A: FloatArray) -> FloatArray:
    """Orthonormal columns that span those of A (V, n, d); zero columns beyond its rank.

    From the eigenvectors of A'A: ten times faster than the singular values of A, and of the few columns of a pose, that
    are scaled to one length, good to 1e-8.
    """
    A = A / np.maximum(np.linalg.norm(A, axis=1, keepdims=True), 1e-300)
    values, vectors = np.linalg.eigh(A.transpose(0, 2, 1) @ A)
    kept = values > 1e-10 * np.maximum(values[:, -1:], 1e-300)
    return A @ (vectors * np.where(kept, 1 / np.sqrt(np.where(kept, values, 1.0)), 0.0)[:, None, :])


def _off_pose(r: FloatArray, Q: FloatArray) -> FloatArray:
    """Residuals (V, N, m) less their pose part."""
    flat = r.reshape(len(r), -1)
    return (flat - (Q @ (Q.transpose(0, 2, 1) @ flat[..., None]))[..., 0]).reshape(r.shape)


def _huber(r_sigma: FloatArray, huber: float) -> FloatArray:
    """Weights (V, N) of residuals (V, N, m) in sigmas for each coordinate."""
    norm = np.linalg.norm(r_sigma, axis=-1) / np.sqrt(r_sigma.shape[-1])
    return np.minimum(1.0, huber / np.maximum(norm, 1e-12))

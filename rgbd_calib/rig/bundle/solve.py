"""Levenberg-Marquardt on the bundle, the structure eliminated, and the covariance from the same equations.

The normal equations, cameras and bow g, structure b (eq. A9-A11 of the paper, with weights and priors):

    [ U  W ] [step_g]     [ g_g ]          S = U - W V^-1 W'      S step_g = -(g_g - W V^-1 g_b)
    [ W' V ] [step_b] = - [ g_b ]          step_b = -V^-1 (g_b + W' step_g)

V is block diagonal, one block for each frame: D x D, 6 of a board's pose, or 3 of each of its corners. Cov_gg = S^-1, Cov_gb = -S^-1 W V^-1, Cov_bb = V^-1 + V^-1 W' S^-1 W V^-1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.bundle import model
from rgbd_calib.rig.bundle.model import N_BOW, Observations, State
from rgbd_calib.types import Board, IntArray

BoolArray = NDArray[np.bool_]

PIXEL_PARTS, DEPTH_PARTS = np.array([0, 1, 2, 3, 3, 3]), np.array([0, 1, 1])
"""What is alike in the pose part of a view: the board's shift along the camera's axes, each by itself, and its turns, in
the pixels; its offset, and its tilts, in the depth."""
OFF_PIXEL, IN_PIXEL, OFF_DEPTH, IN_DEPTH = 0, slice(1, 7), 7, slice(8, 11)
"""Where the parts of a view's residuals stand: pixels off the pose part and in it, depth off it and in it."""
N_PARTS = 11
VIEWS_AT_ONCE = 256
"""Views whose derivatives are in memory together: about 10 MB."""


@dataclass(frozen=True)
class Weights:
    """Sigmas of the observations, the robust weights on top, and the split of a view's residuals into two parts.

    Errors inside one view are not independent: a board that moved between two exposures, or a depth sensor's error that
    is smooth over the image, shift all its corners together. So the residuals of a view are split into what a change of
    the board's pose in this view alone would explain (the columns of Q, orthonormal) and the rest. The estimate weighs
    both alike; the covariance takes the first part's own variances, `ratio`^2 times the rest's.
    """

    sigma_2d_px: FloatArray
    """(C,)."""
    k_depth: FloatArray
    """(C,), 1/m: sigma_z = k z^2."""
    cell_exponent: float
    """Depth of a corner has the deviation k z^2 (cell_ratio)^(-cell_exponent / 2): 1 for white noise in its pixels, 0
    where they err together."""
    ratio_pixel: FloatArray
    """(6,), in the order of the columns of Q; equal within PIXEL_PARTS."""
    ratio_depth: FloatArray
    """(3,), equal within DEPTH_PARTS."""
    robust_pixel: FloatArray
    """(V, N), 0 ... 1."""
    robust_depth: FloatArray
    """(V, N), and less in a view so near that its depth is rounded more than noisy."""
    Q_pixel: FloatArray
    """(V, 2 N, 6): along the camera's axes x, y, z, then turns; less than orthonormal where a view has less."""
    Q_depth: FloatArray
    """(V, N, 3): offset, then tilts."""


@dataclass(frozen=True)
class Prior:
    """Gaussian knowledge of the global parameters, and which of them are free."""

    mean: FloatArray
    """(P,), values of intrinsics, bias and bow in the place of their parameters; poses have none."""
    information: FloatArray
    """(P, P), inverse covariance."""
    free: BoolArray
    """(P,) bool."""
    assumed: BoolArray
    """(P,) bool: the knowledge is an assumption, not a measurement; where the recording adds none, it is said."""


class Status(Enum):
    CONVERGED = "the cost and the step no longer change"
    MAX_ITERATIONS = "the largest number of iterations was reached before the cost settled"


@dataclass(frozen=True)
class Solution:
    state: State
    cost: float
    """Half the weighted sum of squares, priors included."""
    iterations: int
    status: Status


@dataclass(frozen=True)
class System:
    """The normal equations at a state."""

    U: FloatArray
    """(P, P)."""
    W: FloatArray
    """(F, P, D)."""
    V: FloatArray
    """(F, D, D)."""
    gradient: FloatArray
    """(P,)."""
    gradient_structure: FloatArray
    """(F, D)."""


def values(state: State) -> FloatArray:
    """Global parameters (P,) with zeros for the poses, to compare with a prior's mean."""
    per_camera = np.concatenate([np.zeros((len(state.intrinsics), 6)), state.intrinsics, state.bias], axis=1)
    return np.concatenate([per_camera.ravel(), state.bow_m])


def with_values(state: State, which: BoolArray, prior: Prior) -> State:
    """The state with these global parameters (P,) at their prior's mean."""
    step = np.where(which, prior.mean - values(state), 0.0)
    return state.moved(step, np.zeros((len(state.T_parent_board), state.n_structure)))


def cost(state: State, obs: Observations, board: Board, weights: Weights, prior: Prior) -> float:
    """Half the weighted sum of squares."""
    d = values(state) - prior.mean
    return 0.5 * float(np.sum(sums_of_squares(state, obs, board, weights)) + d @ prior.information @ d)


def sums_of_squares(state: State, obs: Observations, board: Board, weights: Weights) -> FloatArray:
    """Weighted sums of squares (N_PARTS, V)."""
    V = len(obs.camera)
    pixel, depth = model.residuals(state, obs, board)
    w_pixel, w_depth = scales(obs, weights)
    r2, r3 = (pixel * w_pixel[..., None]).reshape(V, -1), depth * w_depth
    low2, low3 = np.einsum("vnd,vn->vd", weights.Q_pixel, r2), np.einsum("vnd,vn->vd", weights.Q_depth, r3)
    return _parts(np.sum(r2**2, axis=1), low2**2, np.sum(r3**2, axis=1), low3**2)


def _parts(pixel: FloatArray, in_pixel: FloatArray, depth: FloatArray, in_depth: FloatArray) -> FloatArray:
    """(N_PARTS, V) of totals (V,) and their pose parts (V, 6) and (V, 3)."""
    off = pixel - in_pixel.sum(axis=1), depth - in_depth.sum(axis=1)
    return np.concatenate([off[0][None], in_pixel.T, off[1][None], in_depth.T])


def minimize(
    state: State, obs: Observations, board: Board, weights: Weights, prior: Prior, max_iterations: int, tolerance: float
) -> Solution:
    """The state of least cost for fixed weights.

    Raises
    ------
    CalibrationError
        The equations are singular at the start.
    """
    best = cost(state, obs, board, weights, prior)
    damping = 1e-4
    for iteration in range(1, max_iterations + 1):
        system = build(state, obs, board, weights, prior)
        while True:
            step = _step(system, prior.free, damping)
            trial = state.moved(*step) if step is not None else state
            now = cost(trial, obs, board, weights, prior) if step is not None else np.inf
            if np.isfinite(now) and now <= best and model.in_front(trial, obs, board):
                break
            damping *= 8
            if damping > 1e10:
                if step is None:
                    raise CalibrationError(
                        "the bundle's equations are singular. Are all cameras joined by common views, and is any board pose "
                        "seen whole? Film more common views"
                    )
                return Solution(state, best, iteration, Status.CONVERGED)
        gain = best - now
        state, best, damping = trial, now, max(damping / 8, 1e-12)
        if gain <= tolerance * best:
            return Solution(state, best, iteration, Status.CONVERGED)
    return Solution(state, best, max_iterations, Status.MAX_ITERATIONS)


def build(state: State, obs: Observations, board: Board, weights: Weights, prior: Prior) -> System:
    """The normal equations at a state."""
    P, F, D = state.n_global, len(state.T_parent_board), state.n_structure
    U, W, V = prior.information.copy(), np.zeros((F, P, D)), np.zeros((F, D, D))
    gradient = prior.information @ (values(state) - prior.mean)
    gradient_structure = np.zeros((F, D))
    for part in blocks(state, obs, board, weights):
        n, _, _, G = part.J.shape
        J = part.J.reshape(n, -1, G)
        H = J.transpose(0, 2, 1) @ J
        g = (part.r.reshape(n, 1, -1) @ J)[:, 0]
        for c in np.unique(part.camera):
            at, mine = part.columns[part.camera == c][0], part.camera == c
            U[np.ix_(at, at)] += H[mine, :-D, :-D].sum(axis=0)
            gradient[at] += g[mine, :-D].sum(axis=0)
        np.add.at(W, (part.frame[:, None], part.columns), H[:, :-D, -D:])
        np.add.at(V, part.frame, H[:, -D:, -D:])
        np.add.at(gradient_structure, part.frame, g[:, -D:])
    frame, k = np.nonzero(np.einsum("fii->fi", V) == 0)
    V[frame, k, k] = 1.0  # what no view sees, or no view any more, stays where it is
    return System(U, W, V, gradient, gradient_structure)


@dataclass(frozen=True)
class Block:
    """The weighted equations of some views; n views, N corners, G = 6 + 9 + B + 3 + D local columns."""

    views: slice
    camera: IntArray
    frame: IntArray
    columns: IntArray
    """(n, G - D), global parameter of each local column but the structure's."""
    J: FloatArray
    """(n, N, 3, G)."""
    r: FloatArray
    """(n, N, 3)."""

    def rows(self, weights: Weights) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """For pixels and for depth, their derivatives (n, m, G) and the pose parts of these (n, 6, G) and (n, 3, G)."""
        n, _, _, G = self.J.shape
        both = (self.J[:, :, :2], weights.Q_pixel), (self.J[:, :, 2], weights.Q_depth)
        return tuple((J.reshape(n, -1, G), Q[self.views].transpose(0, 2, 1) @ J.reshape(n, -1, G)) for J, Q in both)


def columns(state: State, camera: IntArray) -> IntArray:
    """Global parameters (n, G - D) of the local columns of views by these cameras (n,): the camera's own, and the bow."""
    own = camera[:, None] * state.n_camera + np.arange(state.n_camera)
    bow = np.arange(state.n_global - N_BOW, state.n_global)
    return np.concatenate([own, np.broadcast_to(bow, (len(own), N_BOW))], axis=1)


def blocks(state: State, obs: Observations, board: Board, weights: Weights) -> Iterator[Block]:
    """The equations of VIEWS_AT_ONCE views after the other, so that memory does not grow with the recording."""
    w_pixel, w_depth = scales(obs, weights)
    w = np.stack([w_pixel, w_pixel, w_depth], axis=-1)
    for first in range(0, len(obs.camera), VIEWS_AT_ONCE):
        views = slice(first, first + VIEWS_AT_ONCE)
        some = obs.only(views)
        lin = model.linearize(state, some, board)
        J = lin.J
        J *= w[views, :, :, None]
        yield Block(views, some.camera, some.frame, columns(state, some.camera), J, lin.residual * w[views])


@dataclass(frozen=True)
class Covariance:
    """Inverse of the normal equations; rows and columns of held parameters are zero."""

    cameras: FloatArray
    """(P, P), global parameters."""
    cross: FloatArray
    """(F, P, D)."""
    structure: FloatArray
    """(F, D, D)."""


def covariance(system: System, free: BoolArray) -> Covariance:
    """Covariance of all unknowns from the equations at the minimum.

    Raises
    ------
    CalibrationError
        They are singular.
    """
    P = len(free)
    W = system.W[:, free]
    V_inv = np.linalg.inv(system.V)
    WV = W @ V_inv
    S = system.U[np.ix_(free, free)] - product(WV, W)
    scale = 1 / np.sqrt(np.diag(S))
    try:
        L = np.linalg.cholesky(S * np.outer(scale, scale))
    except np.linalg.LinAlgError:
        raise CalibrationError(
            "the recording does not determine all unknowns of the bundle (singular equations). Film more common views"
        ) from None
    L_inv = solve_triangular(L, np.diag(scale), lower=True)
    S_inv = L_inv.T @ L_inv
    cross_free = -S_inv @ WV
    structure = V_inv - WV.transpose(0, 2, 1) @ cross_free
    full, cross = np.zeros((P, P)), np.zeros((len(V_inv), P, V_inv.shape[1]))
    full[np.ix_(free, free)] = S_inv
    cross[:, free] = cross_free
    return Covariance(full, cross, structure)


def honest_covariance(
    cov: Covariance, state: State, obs: Observations, board: Board, weights: Weights, prior: Prior
) -> FloatArray:
    """Covariance (P, P) of the global parameters where the pose parts are noisier than the rest.

    The estimate solves A step = -g with one weight for both parts, while g has the covariance B, in which the pose parts
    count `ratio`^2 times: Cov = A^-1 B A^-1 (the sandwich; H. White, Econometrica 48(4), 1980). B's priors count once.
    """
    ratios = weights.ratio_pixel, weights.ratio_depth
    out: FloatArray = cov.cameras @ prior.information @ cov.cameras
    for part in blocks(state, obs, board, weights):
        B = np.zeros((len(part.camera), part.J.shape[-1], part.J.shape[-1]))
        for (rows, in_pose), ratio in zip(part.rows(weights), ratios, strict=True):
            more = in_pose * np.sqrt(ratio**2 - 1)[:, None]  # a ratio is at least 1
            B += rows.transpose(0, 2, 1) @ rows + more.transpose(0, 2, 1) @ more
        M = np.concatenate([cov.cameras[part.columns], cov.cross[part.frame].transpose(0, 2, 1)], axis=1)  # (n, G, P)
        out += product(M.transpose(0, 2, 1) @ B, M.transpose(0, 2, 1))
    return out


def view_traces(cov: Covariance, state: State, obs: Observations, board: Board, weights: Weights) -> FloatArray:
    """tr(J Cov J') of each view's parts, (N_PARTS, V): how many of its residuals the fit absorbed."""
    traces = []
    for part in blocks(state, obs, board, weights):
        of_cameras = cov.cameras[part.columns[:, :, None], part.columns[:, None]]
        cross = cov.cross[part.frame[:, None], part.columns]
        C = np.block([[of_cameras, cross], [cross.transpose(0, 2, 1), cov.structure[part.frame]]])
        absorbed = [np.sum((rows @ C) * rows, axis=2) for pair in part.rows(weights) for rows in pair]
        traces.append(_parts(absorbed[0].sum(axis=1), absorbed[1], absorbed[2].sum(axis=1), absorbed[3]))
    return np.concatenate(traces, axis=1)


def product(A: FloatArray, B: FloatArray) -> FloatArray:
    """Sum over f of A[f] B[f]', of (F, p, m) and (F, q, m), as one matrix product."""
    p, q = A.shape[1], B.shape[1]
    out: FloatArray = A.transpose(1, 0, 2).reshape(p, -1) @ B.transpose(1, 0, 2).reshape(q, -1).T
    return out


def scales(obs: Observations, weights: Weights) -> tuple[FloatArray, FloatArray]:
    """Factors (V, N) of the unweighted residuals: 1 / sigma, times the root of the robust weight, zero where unseen."""
    w_pixel = np.sqrt(weights.robust_pixel) * obs.has_pixel / weights.sigma_2d_px[obs.camera, None]
    w_depth = np.sqrt(weights.robust_depth) * obs.has_depth / depth_sigma(obs, weights.k_depth, weights.cell_exponent)
    return w_pixel, w_depth


def depth_sigma(obs: Observations, k_depth: FloatArray, cell_exponent: float) -> FloatArray:
    """Deviation (V, N) of a corner's depth over z^2, 1/m."""
    sigma: FloatArray = k_depth[obs.camera, None] * obs.cell_ratio ** (-cell_exponent / 2)
    return sigma


def _step(system: System, free: BoolArray, damping: float) -> tuple[FloatArray, FloatArray] | None:
    """The damped step (eq. A11), or None where the equations are singular."""
    V = system.V + damping * np.einsum("fii->fi", system.V)[:, :, None] * np.eye(system.V.shape[1])
    W, g = system.W[:, free], system.gradient[free]
    try:
        V_inv = np.linalg.inv(V)
        WV = W @ V_inv
        n = len(g)
        S = system.U[np.ix_(free, free)] - product(WV, W)
        S[np.diag_indices(n)] += damping * np.diag(system.U)[free]
        scale = 1 / np.sqrt(np.maximum(np.diag(S), 1e-300))
        factor = cho_factor(S * np.outer(scale, scale))
    except np.linalg.LinAlgError:
        return None
    step = np.zeros(len(free))
    step[free] = -scale * cho_solve(factor, scale * (g - np.einsum("fpi,fi->p", WV, system.gradient_structure)))
    structure = -np.einsum("fij,fj->fi", V_inv, system.gradient_structure + np.einsum("fpi,p->fi", W, step[free]))
    return step, structure

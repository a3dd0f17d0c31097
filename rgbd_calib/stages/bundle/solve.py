"""Levenberg-Marquardt on the bundle, the boards' poses eliminated, and the covariance from the same equations.

The normal equations, cameras and bow g, boards b (eq. A9-A11 of the paper, with weights and priors):

    [ U  W ] [step_g]     [ g_g ]          S = U - W V^-1 W'      S step_g = -(g_g - W V^-1 g_b)
    [ W' V ] [step_b] = - [ g_b ]          step_b = -V^-1 (g_b + W' step_g)

V is block diagonal, 6x6 for each frame. Cov_gg = S^-1, Cov_gb = -S^-1 W V^-1, Cov_bb = V^-1 + V^-1 W' S^-1 W V^-1.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.stages.bundle import model
from rgbd_calib.stages.bundle.model import N_BOW, Observations, State
from rgbd_calib.types import Board

BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Weights:
    """Sigmas of the observations, the robust weights on top, and the split of a view's residuals into two parts.

    Errors inside one view are not independent: a board that moved between two exposures, or a depth sensor's error that
    is smooth over the image, shift all its corners together. So the residuals of a view are split into what a change of
    the board's pose in this view alone would explain (the columns of Q, orthonormal) and the rest. The estimate weighs
    both alike; the covariance takes the first part's own variance, `ratio`^2 times the rest's.
    """

    sigma_2d_px: FloatArray
    """(C,)."""
    k_depth: FloatArray
    """(C,), 1/m: sigma_z = k z^2."""
    cell_exponent: float
    """Depth of a corner has the deviation k z^2 (cell_ratio)^(-cell_exponent / 2): 1 for white noise in its pixels, 0
    where they err together."""
    ratio_pixel: float
    ratio_depth: float
    robust_pixel: FloatArray
    """(V, N), 0 ... 1."""
    robust_depth: FloatArray
    """(V, N)."""
    Q_pixel: FloatArray
    """(V, 2 N, 6), zero columns where a view has less."""
    Q_depth: FloatArray
    """(V, N, 3)."""


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
    """The reduced equations at a state, over the free global parameters, and what undoes the reduction."""

    U: FloatArray
    """(P, P)."""
    W: FloatArray
    """(P, F, 6)."""
    V: FloatArray
    """(F, 6, 6)."""
    gradient: FloatArray
    """(P,)."""
    gradient_boards: FloatArray
    """(F, 6)."""
    parts: FloatArray
    """(4, Views, G, G): the information in each view's pixels off the pose part, pixels in it, depth off it and in it."""
    columns: FloatArray
    """(Views, G - 6), global parameter of each local column."""


def values(state: State) -> FloatArray:
    """Global parameters (P,) with zeros for the poses, to compare with a prior's mean."""
    per_camera = np.concatenate([np.zeros((len(state.intrinsics), 6)), state.intrinsics, state.bias], axis=1)
    return np.concatenate([per_camera.ravel(), state.bow_m])


def with_values(state: State, which: BoolArray, prior: Prior) -> State:
    """The state with these global parameters (P,) at their prior's mean."""
    step = np.where(which, prior.mean - values(state), 0.0)
    return state.moved(step, np.zeros((len(state.T_parent_board), 6)))


def cost(state: State, obs: Observations, board: Board, weights: Weights, prior: Prior) -> float:
    """Half the weighted sum of squares."""
    d = values(state) - prior.mean
    return 0.5 * float(np.sum(sums_of_squares(state, obs, board, weights)) + d @ prior.information @ d)


def sums_of_squares(state: State, obs: Observations, board: Board, weights: Weights) -> FloatArray:
    """Weighted sums of squares (4, V): pixels off the pose part and in it, depth off it and in it."""
    V = len(obs.camera)
    pixel, depth = model.residuals(state, obs, board)
    w_pixel, w_depth = scales(obs, weights)
    r2, r3 = (pixel * w_pixel[..., None]).reshape(V, -1), depth * w_depth
    low2, low3 = np.einsum("vnd,vn->vd", weights.Q_pixel, r2), np.einsum("vnd,vn->vd", weights.Q_depth, r3)
    total2, total3, in2, in3 = (np.sum(x**2, axis=1) for x in (r2, r3, low2, low3))
    return np.stack([total2 - in2, in2, total3 - in3, in3])


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
    lin = model.linearize(state, obs, board)
    w_pixel, w_depth = scales(obs, weights)
    V, N = obs.has_pixel.shape
    J2 = (lin.J_pixel * w_pixel[..., None, None]).reshape(V, 2 * N, -1)
    r2 = (lin.pixel * w_pixel[..., None]).reshape(V, 2 * N)
    J3, r3 = lin.J_depth * w_depth[..., None], lin.depth * w_depth
    parts = np.stack([*_split(J2, weights.Q_pixel), *_split(J3, weights.Q_depth)])
    g = np.einsum("vng,vn->vg", J2, r2) + np.einsum("vng,vn->vg", J3, r3)

    P, F, n_cam = state.n_global, len(state.T_parent_board), state.n_camera
    columns = np.concatenate(
        [
            obs.camera[:, None] * n_cam + np.arange(n_cam),
            np.broadcast_to(np.arange(P - N_BOW, P), (V, N_BOW)),
        ],
        axis=1,
    )
    U, W, Vb = prior.information.copy(), np.zeros((F, P, 6)), np.zeros((F, 6, 6))
    gradient = prior.information @ (values(state) - prior.mean)
    gradient_boards = np.zeros((F, 6))
    H = parts.sum(axis=0)
    for v in range(V):
        at, f = columns[v], obs.frame[v]
        U[np.ix_(at, at)] += H[v, :-6, :-6]
        W[f, at] += H[v, :-6, -6:]
        Vb[f] += H[v, -6:, -6:]
        gradient[at] += g[v, :-6]
        gradient_boards[f] += g[v, -6:]
    unseen = ~np.isin(np.arange(F), obs.frame[obs.has_pixel.any(axis=1)])
    Vb[unseen] += np.eye(6)  # boards whose views were all dropped stay where they are
    return System(U, W.transpose(1, 0, 2), Vb, gradient, gradient_boards, parts, columns)


@dataclass(frozen=True)
class Covariance:
    """Inverse of the normal equations; rows and columns of held parameters are zero."""

    cameras: FloatArray
    """(P, P), global parameters."""
    cross: FloatArray
    """(P, F, 6)."""
    boards: FloatArray
    """(F, 6, 6)."""


def covariance(system: System, free: BoolArray) -> Covariance:
    """Covariance of all unknowns from the equations at the minimum.

    Raises
    ------
    CalibrationError
        They are singular.
    """
    P = len(free)
    W = system.W[free]
    V_inv = np.linalg.inv(system.V)
    WV = np.einsum("pfi,fij->pfj", W, V_inv)
    S = system.U[np.ix_(free, free)] - np.einsum("pfi,qfi->pq", WV, W, optimize=True)
    scale = 1 / np.sqrt(np.diag(S))
    try:
        L = np.linalg.cholesky(S * np.outer(scale, scale))
    except np.linalg.LinAlgError:
        raise CalibrationError(
            "the recording does not determine all unknowns of the bundle (singular equations). Film more common views"
        ) from None
    L_inv = solve_triangular(L, np.diag(scale), lower=True)
    S_inv = L_inv.T @ L_inv
    cross_free = -np.einsum("pq,qfi->pfi", S_inv, WV, optimize=True)
    boards = V_inv - np.einsum("pfi,pfj->fij", WV, cross_free, optimize=True)
    full, cross = np.zeros((P, P)), np.zeros((P, *cross_free.shape[1:]))
    full[np.ix_(free, free)] = S_inv
    cross[free] = cross_free
    return Covariance(full, cross, boards)


def honest_covariance(system: System, cov: Covariance, obs: Observations, weights: Weights, prior: Prior) -> FloatArray:
    """Covariance (P, P) of the global parameters where the pose parts are noisier than the rest.

    The estimate solves A step = -g with one weight for both parts, while g has the covariance B, in which the pose parts
    count `ratio`^2 times: Cov = A^-1 B A^-1 (the sandwich; H. White, Econometrica 48(4), 1980). B's priors count once.
    """
    scale = np.array([1.0, weights.ratio_pixel**2, 1.0, weights.ratio_depth**2])
    B = np.einsum("p,pvij->vij", scale, system.parts)
    out: FloatArray = cov.cameras @ prior.information @ cov.cameras
    for v, f in enumerate(obs.frame):
        M = np.concatenate([cov.cameras[:, system.columns[v]], cov.cross[:, f]], axis=1)
        out = out + M @ B[v] @ M.T
    return out


def view_traces(system: System, cov: Covariance, obs: Observations) -> FloatArray:
    """tr(J Cov J') of each view's four parts, (4, V): how many of its residuals the fit absorbed."""
    traces = np.empty((4, len(obs.camera)))
    for v, f in enumerate(obs.frame):
        at = system.columns[v]
        cross = cov.cross[at, f]
        C = np.block([[cov.cameras[np.ix_(at, at)], cross], [cross.T, cov.boards[f]]])
        traces[:, v] = np.einsum("pij,ij->p", system.parts[:, v], C)
    return traces


def scales(obs: Observations, weights: Weights) -> tuple[FloatArray, FloatArray]:
    """Factors (V, N) of the unweighted residuals: 1 / sigma, times the root of the robust weight, zero where unseen."""
    w_pixel = np.sqrt(weights.robust_pixel) * obs.has_pixel / weights.sigma_2d_px[obs.camera, None]
    w_depth = np.sqrt(weights.robust_depth) * obs.has_depth / depth_sigma(obs, weights.k_depth, weights.cell_exponent)
    return w_pixel, w_depth


def depth_sigma(obs: Observations, k_depth: FloatArray, cell_exponent: float) -> FloatArray:
    """Deviation (V, N) of a corner's depth over z^2, 1/m."""
    sigma: FloatArray = k_depth[obs.camera, None] * obs.cell_ratio ** (-cell_exponent / 2)
    return sigma


def _split(J: FloatArray, Q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Information of a view's rows (V, n, G) off the pose part, (V, G, G), and in it."""
    QJ = np.matmul(Q.transpose(0, 2, 1), J)
    H_pose = np.matmul(QJ.transpose(0, 2, 1), QJ)
    return np.matmul(J.transpose(0, 2, 1), J) - H_pose, H_pose


def _step(system: System, free: BoolArray, damping: float) -> tuple[FloatArray, FloatArray] | None:
    """The damped step (eq. A11), or None where the equations are singular."""
    V = system.V + damping * np.einsum("fii->fi", system.V)[:, :, None] * np.eye(6)
    W, g = system.W[free], system.gradient[free]
    try:
        V_inv = np.linalg.inv(V)
        WV = np.einsum("pfi,fij->pfj", W, V_inv)
        n = len(g)
        S = system.U[np.ix_(free, free)] - WV.reshape(n, -1) @ W.reshape(n, -1).T
        S[np.diag_indices(n)] += damping * np.diag(system.U)[free]
        scale = 1 / np.sqrt(np.maximum(np.diag(S), 1e-300))
        factor = cho_factor(S * np.outer(scale, scale))
    except np.linalg.LinAlgError:
        return None
    step = np.zeros(len(free))
    step[free] = -scale * cho_solve(factor, scale * (g - np.einsum("pfi,fi->p", WV, system.gradient_boards)))
    boards = -np.einsum("fij,fj->fi", V_inv, system.gradient_boards + np.einsum("pfi,p->fi", W, step[free]))
    return step, boards

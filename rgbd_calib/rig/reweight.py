"""The weights that the residuals give: variance components of pixels and depth, robust weights, pose parts of the views.

Helmert's and Forstner's estimate of a variance from the residuals of its group: sigma^2 = sum r^2 / redundancy, with
redundancy = residuals - tr(J Cov J'), what the fit absorbed. Groups: the pixels of each camera, off the pose part; the
depth of each camera, off it; and the kinds of pose part of all views together (their ratio to the rest, at least 1): a
finder that draws whole boards to one side shifts them, and does not turn them. Where parts are weighed by their ratio,
what the fit absorbs of them is compared with ratio^2. How the depth's variance falls with the size
of a corner's cell is one exponent for all cameras.

Depth comes in whole units, and neighbouring pixels of a board round alike: averaging a cell's pixels lowers their noise, not
the rounding. So unit^2 / 12 is added to a corner's variance, in the weight of its whole view; that tells near the camera,
where the noise is a fraction of the unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from rgbd_calib.geometry.linear import Assembly, Covariance, IntArray
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Kind
from rgbd_calib.rig.blocks.board_shape import nominal_corners_m
from rgbd_calib.rig.observations import Observations
from rgbd_calib.rig.pose_rows import N_PARTS, pose_rows
from rgbd_calib.rig.problem import OF_BOARDS, Problem, State
from rgbd_calib.rig.weights import (
    DEPTH_PARTS,
    N_PIXEL,
    PIXEL_PARTS,
    Weights,
    huber,
    in_order,
    kinds_of,
    orthonormal,
    split,
)

MIN_CELL_SPREAD = 0.01
"""Least variance of the logarithm of the cells' sizes that tells how noise falls with them."""
PATCHES = (10, 8)
"""Of the image of a wall, across and down: finer than the shapes of a depth field."""
MIN_PATCHES = 27
"""Patches that a field of the sixth degree explains."""
WALL_PARAMETERS = 3
MOST_K_WALL = 5e-3
"""Of the mean of a cell: single pixels of the worst sensors have this. Walls that fit worse are not noisy; what pulls the
estimate away from them, as depth of other instants does, must not put them out."""
MEDIAN_OF_ABSOLUTE = 0.6745
"""Of a normal error, in deviations."""
DISTANCE_DOF = 1.0
"""Of what was said of the walls' distances, or assumed: known to a factor of two or three."""
BEND_DOF = 1.0
"""Of what is usual of the walls' bends."""
TILT_DOF = 1e-4
"""Of what is usual of how far each wall is from where the others are: cameras on a rail have them all alike."""
DISTANCE_SIGMAS = 2.0
"""A written distance that is farther off counts less: a dozen of them do not average a slip out."""
SIZE_STEP = 0.6
"""Of the way to the new size, as logarithms: what a size makes of the estimate is not linear, and a full step may swing."""
SIZE_ROUNDS = 50
"""Of the sizes of variance components and their parameters."""
SIZE_TOLERANCE = 1e-4
"""Relative change of the squares of the sizes that ends them: a hundredth of what counts as a change of the weights."""
MIN_REDUNDANCY = 10.0
"""A group with less takes the variance of all cameras together."""


def reweighted(problem: Problem, state: State, covariance: Covariance) -> Weights:
    """The weights that the residuals at `state` give, by the covariance under the present ones."""
    obs, old, n_cameras, own = problem.obs, problem.weights, len(problem.setup.cameras), problem.setup.params
    pixel, depth = problem.residuals(state)
    w_pixel, w_depth = old.scales(obs)
    r2, r3 = (pixel * w_pixel[..., None]).reshape(len(pixel), -1), depth * w_depth
    in_squares = np.concatenate([split(r2, old.Q_pixel)[1], split(r3, old.Q_depth)[1]], axis=1).T ** 2  # (parts, V)
    by_camera = {(kind, c): Assembly(problem.pattern) for kind in OF_BOARDS for c in range(n_cameras)}
    rows = pose_rows(problem, state, lambda look, rows: by_camera[look.kind, look.camera].add(rows))
    absorbed = rows.absorbed(covariance, obs.camera).T
    traces = {key: covariance.trace(own.equations()) for key, own in by_camera.items()}  # tr(J Cov J')
    dims = np.concatenate([np.sum(Q**2, axis=1) for Q in (old.Q_pixel, old.Q_depth)], axis=1).T  # (parts, V)
    parts = slice(0, N_PIXEL), slice(N_PIXEL, N_PARTS)
    n3 = np.maximum(obs.has_depth.sum(axis=1), 1)
    whole = 2 * np.sum(old.robust_pixel * obs.has_pixel, axis=1), np.sum(old.robust_depth * obs.has_depth, axis=1)
    factors, ratios = [], []
    for kind, r, rows_of_view, part, names in (
        (Kind.PIXEL, r2, whole[0] - dims[parts[0]].sum(axis=0), parts[0], PIXEL_PARTS),
        (Kind.DEPTH, r3, whole[1] * (1 - dims[parts[1]].sum(axis=0) / n3), parts[1], DEPTH_PARTS),
    ):
        of_view = np.sum(r**2, axis=1) - in_squares[part].sum(axis=0), rows_of_view, absorbed[part].sum(axis=0)
        squares, count, in_pose = (np.asarray(np.bincount(obs.camera, x, minlength=n_cameras), float) for x in of_view)
        total = np.array([traces[kind, c] for c in range(n_cameras)])
        factor = _by_camera(squares, count - (total - in_pose))
        factors.append(factor)
        before2 = old.parts(kind)[1][:, None] ** 2
        ratios.append(_ratios(in_squares[part] / factor[obs.camera], dims[part] - absorbed[part] / before2, names))
    distance_factor, robust_distance = _distance_weights(problem, state, covariance)
    new = replace(
        old,
        sigma_2d_px=old.sigma_2d_px * np.sqrt(factors[0]),
        k_depth=old.k_depth * np.sqrt(factors[1]),
        ratio_pixel=ratios[0],
        ratio_depth=ratios[1],
        sizes=_sizes(problem, state, covariance),
        wall_tilt=_wall_sizes(problem, state, covariance, slice(1, 3), old.wall_tilt, own.wall_tilt_sd_rad, TILT_DOF),
        wall_bend=_wall_sizes(problem, state, covariance, slice(3, 6), old.wall_bend, own.wall_bend, BEND_DOF),
        distance_factor=distance_factor,
        robust_distance=robust_distance,
    )
    return _robust(problem, state, new, pixel, depth)


def _sizes(problem: Problem, state: State, covariance: Covariance) -> dict[str, float]:
    """The sizes of the variance components: scaled inverse chi^2 about what is usual, of the parameters that the data tell.

    theta' R theta / size^2 ~ chi^2 with as many degrees of freedom as the data have taken from the prior's, tr((P^-1 - C) R) /
    size^2 with P what is known before, of which the component is R / size^2 (D. MacKay, Neural Computation 4(3), 1992). As a small size draws its parameters to zero, and small parameters their size,
    both are iterated, on what the data say of a block's parameters with all other unknowns eliminated.
    """
    theta, sizes = problem.vector(state), dict(problem.weights.sizes)
    for group in problem.component_groups:
        at = np.concatenate([index for index, _ in group])
        stops = np.cumsum([0, *(len(index) for index, _ in group)])
        parts = [slice(first, last) for first, last in pairwise(stops)]
        R = [component.structure for _, component in group]
        size2 = np.array([sizes[component.name] ** 2 for _, component in group])
        C_now, now, before = covariance.of_globals[np.ix_(at, at)], theta[at], _prior(R, size2, parts)
        unseen = np.linalg.inv(problem.prior.information[np.ix_(at, at)])
        n_free = [float(np.sum(unseen[p, p] * r)) / s2 for p, r, s2 in zip(parts, R, size2, strict=True)]
        right = np.column_stack([C_now, now])
        for _ in range(SIZE_ROUNDS):
            more = np.eye(len(at)) + C_now @ (_prior(R, size2, parts) - before)
            solved = np.linalg.solve(more, right)
            C, own, last = solved[:, :-1], solved[:, -1], size2.copy()
            for k, (part, (_, c)) in enumerate(zip(parts, group, strict=True)):
                n_told = max(n_free[k] - float(np.sum(C[part, part] * R[k])) / size2[k], 0.0)
                squares = c.dof * c.usual**2 + float(own[part] @ R[k] @ own[part])
                size2[k] = min(squares / (c.dof + n_told), c.most**2)
            if np.all(np.abs(np.log(size2 / last)) < SIZE_TOLERANCE):
                break
        for (_, c), size in zip(group, size2, strict=True):
            sizes[c.name] *= (float(np.sqrt(size)) / sizes[c.name]) ** SIZE_STEP
    return sizes


def _distance_weights(problem: Problem, state: State, covariance: Covariance) -> tuple[float, FloatArray]:
    """How good the walls' distances turn out to be, as a variance component, and which of them are slips of the pen."""
    walls, old = problem.setup.walls, problem.weights
    if not walls.n:
        return old.distance_factor, old.robust_distance
    t = state.walls.values[:, 0] / walls.sd_m
    left = covariance.of_units[-walls.n :, 0, 0] / walls.sd_m**2
    told = max(float(np.sum(1 - old.robust_distance * left / old.distance_factor**2)), 0.0)
    factor2 = (DISTANCE_DOF + float(np.sum(old.robust_distance * t**2))) / (DISTANCE_DOF + told)
    robust = huber(t[:, None, None] / np.sqrt(factor2), DISTANCE_SIGMAS)[:, 0]
    return float(np.sqrt(factor2)), robust


def _wall_sizes(
    problem: Problem, state: State, covariance: Covariance, part: slice, sizes: FloatArray, usual: float, dof: float
) -> FloatArray:
    """Size (C,) of some of the walls' own unknowns, a variance component of each camera."""
    walls, size2 = problem.setup.walls, sizes**2
    values = state.walls.values[:, part]
    left = np.einsum("wkk->wk", covariance.of_units[problem.n_board_units :, part, part])
    for c in np.unique(walls.camera):
        mine = walls.camera == c
        told = max(float(np.sum(1 - left[mine] / size2[c])), 0.0)
        size2[c] = (dof * usual**2 + float(np.sum(values[mine] ** 2))) / (dof + told)
    return np.asarray(np.sqrt(size2))


def _prior(R: Sequence[FloatArray], size2: FloatArray, parts: Sequence[slice]) -> FloatArray:
    out = np.zeros((parts[-1].stop,) * 2)
    for one, part, size in zip(R, parts, size2, strict=True):
        out[part, part] = one / size
    return out


def _wall_weights(problem: Problem, state: State) -> tuple[FloatArray, FloatArray]:
    """k (C,) and robust weights (W, N) of the cells of walls.

    What neighbouring cells of a wall, and the same place of all walls, have in common is no noise that averages out: the
    variance is that of the means of patches, of each wall or over all, times the cells in each.
    """
    walls, old, own = problem.setup.walls, problem.weights, problem.setup
    k, robust = old.k_wall.copy(), old.robust_wall
    if not walls.n:
        return k, robust
    r = problem.wall_residuals(state) / np.where(walls.seen, walls.depth_m**2, 1.0)
    for c in range(len(own.cameras)):
        mine = walls.camera == c
        used = walls.seen[mine]
        if not used.any():
            continue
        place = np.clip((walls.pixels_px[mine] + 0.5) / own.sizes_px[c] * PATCHES, 0, np.array(PATCHES) - 1).astype(int)
        patch = (place[..., 0] * PATCHES[1] + place[..., 1])[used]
        of_wall = np.nonzero(used)[0] * np.prod(PATCHES) + patch
        w, own_r = robust[mine][used], r[mine][used]
        alone = float(np.sum(w * own_r**2) / np.sum(w))
        n_planes = WALL_PARAMETERS * int(used.any(axis=1).sum())
        of_patches = (_variance(of_wall, w, own_r, n_planes), _variance(patch, w, own_r, MIN_PATCHES))
        k[c] = np.clip(np.sqrt(max(alone, *of_patches)), 1e-6, MOST_K_WALL)
    sigma = np.where(walls.seen, k[walls.camera, None], 1.0)
    alone_sigma = np.sqrt(np.median((r**2)[walls.seen])) / MEDIAN_OF_ABSOLUTE if walls.seen.any() else 1.0
    return k, huber((r / np.minimum(sigma, 3 * alone_sigma))[..., None], own.params.huber_sigmas) * walls.seen


def _variance(group: IntArray, w: FloatArray, r: FloatArray, n_fitted: int) -> float:
    """Of single values r (n,) with weights w, from the means of groups, of which `n_fitted` parameters have followed."""
    count, total = np.bincount(group, w), np.bincount(group, w * r)
    there = count > 0
    return float(np.sum(total[there] ** 2 / count[there])) / max(int(there.sum()) - n_fitted, 1)


def _robust(problem: Problem, state: State, new: Weights, pixel: FloatArray, depth: FloatArray) -> Weights:
    """Pose parts, cell exponent and robust weights under the new sigmas."""
    obs, limit = problem.obs, problem.setup.params.huber_sigmas
    sigma3 = new.depth_sigma_m(obs)
    Q_pixel, Q_depth = pose_parts(problem, state, sigma3)
    V = len(obs.camera)
    off2 = split((pixel / new.sigma_2d_px[obs.camera, None, None]).reshape(V, -1), Q_pixel)[0].reshape(V, -1, 2)
    off3 = split(depth / sigma3, Q_depth)[0]
    exponent = float(np.clip(new.cell_exponent + _cell_slope(off3, obs), 0.0, 1.0))
    n3 = np.maximum(obs.has_depth.sum(axis=1), 1)
    noise3_m2 = np.mean(new.ratio_depth**2) * np.sum(sigma3**2 * obs.has_depth, axis=1) / n3
    rounding = noise3_m2 / np.maximum(noise3_m2 + obs.rounding_m**2, 1e-30)
    k_wall, robust_wall = _wall_weights(problem, state)
    return replace(
        new,
        k_wall=k_wall,
        robust_wall=robust_wall,
        cell_exponent=exponent,
        robust_pixel=huber(off2, limit),
        robust_depth=huber(off3[..., None], limit) * rounding[:, None],
        Q_pixel=Q_pixel,
        Q_depth=Q_depth,
    )


def pose_parts(
    problem: Problem, state: State, depth_sigma_m: FloatArray, obs: Observations | None = None
) -> tuple[FloatArray, FloatArray]:
    """Orthonormal bases of what a change of the board's pose does to a view's pixels (V, 2 N, 6), its shifts along the
    camera's axes first, and to its depth (V, N, 3), its offset first, in sigmas."""
    obs = problem.obs if obs is None else obs
    V, N = obs.has_pixel.shape
    J2, first = np.zeros((V, 2 * N, 6)), np.zeros((V, 2 * N, 3))
    for views, sight in problem.sights(state, None, obs):
        look = problem.look_at_pixels(state, sight)
        own = (look.by_motion * sight.obs.has_pixel[:, :, None, None]).reshape(len(views), 2 * N, 6)
        J2[views], first[views] = own, own[..., 3:] @ sight.R_color_parent.transpose(0, 2, 1)
    on_board = nominal_corners_m(problem.setup.board)[obs.back[:, None], obs.corner][..., :2]
    flat = np.concatenate([np.ones((V, N, 1)), on_board], axis=-1) * (obs.has_depth / depth_sigma_m)[..., None]
    return in_order(orthonormal(J2), first), in_order(orthonormal(flat), flat)


def _cell_slope(r_sigma: FloatArray, obs: Observations) -> float:
    """How much faster the variance falls with a cell's size than its weight says, as an exponent.

    Slope of log r^2 over log size, about each camera's own means; the logarithm keeps outliers from counting.
    """
    used = obs.has_depth & (np.abs(r_sigma) > 1e-9)
    x, y = np.log(obs.cell_ratio[used]), np.log(r_sigma[used] ** 2)
    camera = np.broadcast_to(obs.camera[:, None], used.shape)[used]
    count = np.maximum(np.bincount(camera), 1)
    x, y = (v - (np.bincount(camera, v) / count)[camera] for v in (x, y))
    spread = float(x @ x)
    return -float(x @ y) / spread if spread > MIN_CELL_SPREAD * len(x) else 0.0


def _by_camera(squares: FloatArray, redundancy: FloatArray) -> FloatArray:
    """Variance factor of each camera (n,); the pooled one where a camera has too little redundancy."""
    pooled = squares.sum() / redundancy.sum() if redundancy.sum() > MIN_REDUNDANCY else 1.0
    factor = np.where(redundancy > MIN_REDUNDANCY, squares / np.maximum(redundancy, 1e-9), pooled)
    return np.maximum(factor, 1e-12)


def _ratios(squares: FloatArray, redundancy: FloatArray, kinds: IntArray) -> FloatArray:
    """The pose part's standard deviation over the rest's, (d,), of squares (d, V), at least 1; that of all where a kind has
    too little redundancy."""
    total, left = kinds_of(kinds, squares), kinds_of(kinds, redundancy)
    pooled = total.sum() / left.sum() if left.sum() > MIN_REDUNDANCY else 1.0
    own = np.where(left > MIN_REDUNDANCY, total / np.maximum(left, 1e-9), pooled)
    return np.asarray(np.sqrt(np.maximum(own, 1.0))[kinds])

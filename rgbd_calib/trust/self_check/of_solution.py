"""The equations of a solved bundle, with columns for the errors that its model does not have."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rgbd_calib.geometry.linear import BoolArray, IntArray, NormalEquations, assemble
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks import ESTIMATED, HELD, Block
from rgbd_calib.rig.blocks.board_scale import BoardScale
from rgbd_calib.rig.common_errors import common_gradients
from rgbd_calib.rig.motion.problem import MotionProblem
from rgbd_calib.rig.motion.scale import CarriedScale
from rgbd_calib.rig.pose_rows import N_PARTS, dense, part_of
from rgbd_calib.rig.problem import OF_BOARDS, Problem, State
from rgbd_calib.rig.solution import Solution
from rgbd_calib.rig.weights import DEPTH_PARTS, N_DEPTH, N_PIXEL, PIXEL_PARTS
from rgbd_calib.trust.self_check.equations import ALONE, Equations
from rgbd_calib.trust.self_check.model import SolvedModel, ViewRows

MAX_VIEWS = 800
"""Of more views, every second, third, ... frame is checked: the equations of 800 take some 100 MB."""
GROUPS = np.concatenate([PIXEL_PARTS, PIXEL_PARTS.max() + 1 + DEPTH_PARTS])
"""What is alike in the pose part of a view, in the pixels and in the depth."""
HELD_OF_CARRIED = tuple(CarriedScale if block is BoardScale else block for block in HELD)


def held_blocks(problem: Problem) -> tuple[Block, ...]:
    """What the problem holds at zero: always, or because it was asked to."""
    listed = HELD_OF_CARRIED if isinstance(problem, MotionProblem) else HELD
    held = [block for block in (*listed, *ESTIMATED) if block.held is not None and block.name not in problem.parts]
    return tuple(block(problem.setup) for block in held if block.applies(problem.setup))


def equations_of(solution: Solution, held: Sequence[Block], frames: Sequence[str]) -> Equations:
    """Equations at the solution; `frames` are the recording's in order of time, others are of a camera alone.

    Raises
    ------
    numpy.linalg.LinAlgError
        They are singular.
    """
    problem, state = solution.problem, solution.state
    views = _thinned(problem)
    obs = problem.obs.only(views)
    tested = [*(b for b in problem.blocks if b.scope.value == "camera"), *held]
    stops = np.cumsum([b.n for b in tested])
    columns = {b.name: slice(int(s) - b.n, int(s)) for b, s in zip(tested, stops, strict=True)}
    metres = _metres(problem, state)
    gradient = problem.prior.information @ (problem.vector(state) - problem.prior.mean)
    whole = len(views) == int(_used(problem).any(axis=1).sum())
    base = problem.equations(state, None if whole else views)
    at = {name: k for k, name in enumerate(frames)}
    of_frame = np.array([at.get(name, ALONE) for name in solution.course.frames])
    distance = np.zeros(len(problem.obs.camera))
    for some, sight in problem.sights(state, views):
        seen = sight.obs.has_pixel | sight.obs.has_depth
        distance[some] = np.where(seen, sight.p_color[..., 2], 0.0).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)

    def part(some: IntArray) -> NormalEquations:
        return problem.data_equations(state, views[some], OF_BOARDS)

    def part_in_metres(some: IntArray) -> NormalEquations:
        rows = problem.rows(state, views[some], metres)
        in_metres = assemble(problem.pattern, (own for _, _, own in rows))
        return problem.eliminable(in_metres, state, float(np.trace(in_metres.U) / np.trace(base.U)))

    def common(some: IntArray) -> FloatArray:
        return common_gradients(solution.common, problem, state, base, views[some])

    eq = Equations(
        solution.cameras,
        obs.camera,
        of_frame[obs.frame],
        obs.shared,
        tuple(frames),
        columns,
        SolvedModel(
            _view_rows(problem, state, tested, columns, views, metres),
            base.covariance(problem.prior.free),
            problem.prior.free,
        ),
        problem.prior.information,
        gradient,
        _used(problem)[views].sum(axis=1),
        distance[views],
        GROUPS,
        np.concatenate([problem.weights.parts(kind)[1] for kind in OF_BOARDS]),
        np.zeros(len(GROUPS)),
        part,
        part_in_metres,
        common,
    )
    return eq.weighed()


def _thinned(problem: Problem) -> IntArray:
    """Views that are used, of every frame or of every n-th."""
    obs = problem.obs
    views = np.flatnonzero(_used(problem).any(axis=1))
    every = -(-len(views) // MAX_VIEWS)
    if every == 1:
        return views
    shared = np.unique(obs.frame[views][obs.shared[views]])[::every]
    alone = np.unique(obs.frame[views][~obs.shared[views]])[::every]
    return views[np.isin(obs.frame[views], np.concatenate([shared, alone]))]


def _used(problem: Problem) -> BoolArray:
    """(V, N) corners that say anything."""
    return np.asarray(problem.obs.has_pixel | problem.obs.has_depth)


def _metres(problem: Problem, state: State) -> tuple[FloatArray, FloatArray]:
    """Factors (V, N) that make of rows in px and metres such in metres at the board."""
    out = np.zeros(problem.obs.depth_m.shape)
    for views, sight in problem.sights(state):
        out[views] = sight.p_color[..., 2] / state.intrinsics[sight.camera, 0]
    return out * problem.obs.has_pixel, problem.obs.has_depth.astype(float)


def _view_rows(
    problem: Problem,
    state: State,
    tested: Sequence[Block],
    columns: dict[str, slice],
    views: IntArray,
    metres: tuple[FloatArray, FloatArray],
) -> ViewRows:
    obs, scales = problem.obs, problem.weights.scales(problem.obs)
    place = np.full(len(obs.camera), -1)
    place[views] = np.arange(len(views))
    V, H, P, D = len(views), sum(b.n for b in tested), problem.n_globals, problem.unit_size
    gram, size, score = np.zeros((V, H, H)), np.zeros((V, H, H)), np.zeros((V, H))
    by_globals: list[FloatArray] = [np.zeros(0)] * V
    index: list[IntArray] = [np.zeros(0, int)] * V
    kinds = len(OF_BOARDS)
    units = np.repeat(obs.frame[views, None], kinds, axis=1)
    by_unit, low = np.zeros((V, kinds, H, D)), np.zeros((V, N_PARTS, H))
    low_globals, low_unit, low_residual = np.zeros((V, N_PARTS, P)), np.zeros((V, N_PARTS, D)), np.zeros((V, N_PARTS))
    for some, look, rows in problem.rows(state, views):
        own, n, kind = place[some], len(some), look.kind
        of_kind = OF_BOARDS.index(kind)
        units[own, of_kind] = rows.units
        A = np.zeros((*look.left.shape, H))
        for block in tested:
            if block.changes(look):
                A[..., columns[block.name]] = block.derivative(look)
        in_metres = (A * metres[of_kind][some][..., None, None]).reshape(n, -1, H)
        size[own] += in_metres.transpose(0, 2, 1) @ in_metres
        A = (A * scales[of_kind][some][..., None, None]).reshape(n, -1, H)
        Q, ratio = problem.weights.parts(kind)
        parts, A_parts, at = rows.parts(Q[some]), Q[some].transpose(0, 2, 1) @ A, part_of(kind)
        J, J_unit, r = (np.concatenate(both, axis=1) for both in zip(rows.flat(), parts.flat(), strict=True))
        off = A_parts * (ratio**-2 - 1)[:, None]
        WA = np.concatenate([A, off], axis=1).transpose(0, 2, 1)  # times rows and their pose parts: A' W
        gram[own] += WA @ np.concatenate([A, A_parts], axis=1)
        score[own] += (WA @ r[..., None])[..., 0]
        by_unit[own, of_kind] += WA @ J_unit
        low[own, at] = A_parts / ratio[:, None]
        own_parts = dense(parts.times(1 / ratio), P)
        low_globals[own, at], low_unit[own, at], low_residual[own, at] = own_parts
        by_dense = WA @ J
        N, per, s = rows.J_point.shape[1:]
        points = np.einsum("nirh,nirs->nhis", A.reshape(n, N, per, H), rows.J_point).reshape(n, H, N * s)
        points += off.transpose(0, 2, 1) @ parts.J_point[:, 0]
        for k, v in enumerate(own):
            by_globals[v] = np.concatenate([by_globals[v].reshape(H, -1), by_dense[k], points[k]], axis=1)
            index[v] = np.concatenate([index[v], rows.columns, rows.point_columns[k].ravel()])
    return ViewRows(
        units,
        _stacked(index),
        gram,
        _stacked(by_globals),
        by_unit,
        score,
        low,
        low_globals,
        low_unit,
        low_residual,
        size,
        np.repeat(np.arange(kinds), [N_PIXEL, N_DEPTH]),
    )


def _stacked(rows: Sequence[np.ndarray]) -> np.ndarray:
    """(V, ..., n) of arrays (..., n) of several lengths; zeros, of global 0, fill up the shorter ones."""
    n = max(own.shape[-1] for own in rows)
    return np.stack([np.pad(own, [(0, 0)] * (own.ndim - 1) + [(0, n - own.shape[-1])]) for own in rows])

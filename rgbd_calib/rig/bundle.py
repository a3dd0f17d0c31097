"""The joint bundle of all cameras, boards, intrinsics and depth errors, on pixels and depth together.

The pixels alone leave the focal lengths a little free, and with them the distances: that error dominates a real rig.
Measured depth pins them. :mod:`.blocks` has the unknowns, :mod:`.terms` what is predicted, :mod:`.problem` puts them
together, :mod:`.solve` minimises, :mod:`.reweight` estimates the weights, :mod:`.outliers` says what is dropped; here are the
rounds of all this: solve, weigh, drop, until nothing changes; then once more with the depth of whole boards weighed by its own
variance, which outliers would have swollen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig import faces, observability, outliers, solve
from rgbd_calib.rig.blocks import Boards
from rgbd_calib.rig.blocks.registration import turn_of_rays
from rgbd_calib.rig.common_errors import common_errors
from rgbd_calib.rig.local_field import local_fields
from rgbd_calib.rig.observations import Walls, observe
from rgbd_calib.rig.problem import Problem, State
from rgbd_calib.rig.reweight import reweighted
from rgbd_calib.rig.setup import BundleParams, CameraPrior, Setup
from rgbd_calib.rig.solution import Course, Round, Solution
from rgbd_calib.rig.unknown_sizes import covariance_of_sizes
from rgbd_calib.rig.weights import Weights
from rgbd_calib.types import Board, PlacedView

SCALES_KNOWN = 0.1
"""Relative change of the sigmas below which they are known well enough to call something an outlier."""
ROUGH_TOLERANCE = 0.1
"""Relative change of the cost that ends a minimisation before: it is for the sigmas alone."""
MAX_READINGS = 8
"""Rounds after which frames may be read anew; three or four do."""
MIN_SHARE_LEFT = 0.2
"""Of a camera's views that others share: where fewer agree with the rest, the camera is not of this rig."""


def problem_of(
    views: Sequence[PlacedView],
    board: Board,
    priors: Mapping[str, CameraPrior],
    T_world_color: Mapping[str, FloatArray],
    reference: str,
    params: BundleParams,
    walls: Walls | None = None,
) -> tuple[Problem, State, tuple[str, ...]]:
    """The problem with its first weights, where it starts, and the frames of its boards; as for :func:`bundle`."""
    obs, frames = observe(views, board, {name: prior.depth_unit_m for name, prior in priors.items()})
    setup = Setup.of(priors, reference, T_world_color, board, obs, params, walls)
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    for placed, f, shared in zip(views, obs.frame, obs.shared, strict=True):
        poses[f] = T_world_color[placed.view.camera] @ placed.T_color_board if shared else placed.T_color_board
    problem = Problem.of(setup)
    return problem, problem.start(Boards(poses, np.zeros(len(frames), bool), np.zeros((len(frames), 0, 3)))), frames


def bundle(
    views: Sequence[PlacedView],
    board: Board,
    priors: Mapping[str, CameraPrior],
    T_world_color: Mapping[str, FloatArray],
    reference: str,
    params: BundleParams | None = None,
    walls: Walls | None = None,
) -> Solution:
    """Solve for everything at once.

    Parameters
    ----------
    views : all views; several cameras' views of one frame are of one board pose. Views of an intrinsic recording are
        frames of their own.
    priors, T_world_color : by camera; the poses are a start.
    walls : of a bias recording.

    Raises
    ------
    CalibrationError
        The equations are singular, or too few views are left.
    """
    params = params or BundleParams()
    return solved(*problem_of(views, board, priors, T_world_color, reference, params, walls), views)


def solved(problem: Problem, state: State, frames: tuple[str, ...], views: Sequence[PlacedView]) -> Solution:
    """The rounds of :func:`bundle`, from a problem of these views and its start."""
    params, board = problem.setup.params, problem.setup.board
    dropped, dropped_corners = dict[tuple[str, str], str](), 0
    history: list[Round] = []
    iterations, precise, settled, taken_back = 0, False, False, False
    keys = [(placed.view.camera, placed.view.frame) for placed in views]
    n_readings = MAX_READINGS if faces.ambiguous(board) and problem.reads_faces else 0
    last_alike = n_readings + params.max_rounds
    for k in range(last_alike + params.max_rounds):
        problem, state, moved, done = _round(problem, state, len(dropped), precise)
        iterations, history = iterations + done[0], [*history, done[1]]
        if k < n_readings:
            readings = faces.best_readings(problem, state)
            if readings.n_changed:
                views = faces.read_views(views, problem.obs.frame, readings, board)
                problem, state = faces.read(problem, state, readings.moves, readings.of_frame)
                continue
            n_readings = 0  # once nothing changes, nothing is read again
        if not precise and k < last_alike:
            precise = moved < SCALES_KNOWN
            continue
        if moved < SCALES_KNOWN:
            found = outliers.find(problem, state)
            reasons = dict(found.pixel_views) | {
                v: f"depth rejected as an outlier: {why}" for v, why in found.depth_views.items()
            }
            dropped |= {keys[v]: why for v, why in reasons.items()}
            dropped_corners += found.depth_corners
            if reasons or found.depth_corners:
                problem = problem.using(found.obs)
                _check_left(problem, dropped)
                continue
        if moved < params.weight_tolerance:
            if dropped and not taken_back:
                taken_back = True
                obs, back = outliers.take_back(problem, state)
                if back:
                    problem = problem.using(obs)
                    dropped = {key: why for key, why in dropped.items() if key not in {keys[v] for v in back}}
                    continue
            if settled := problem.weights.weighs_depth:
                break
        if moved < params.weight_tolerance or k >= last_alike:
            problem = replace(problem, weights=replace(problem.weights, weighs_depth=True))
    course = Course(
        tuple(views), frames, dropped, dropped_corners, tuple(history), iterations, settled, _message(settled, params)
    )
    return _concluded(problem, state, course)


def free_structure(solution: Solution) -> Solution:
    """The bundle again, with the corners of shared frames as free points instead of a rigid board (the paper, eq. 4.5).

    For boards whose print or flatness is not to be trusted. `solution`, from :func:`bundle`, is the start, and has found the
    outliers. The scale then comes from the depth, and from the views of single cameras, which keep the board.

    Raises
    ------
    CalibrationError
        No two cameras have depth on common corners, or the equations are singular.
    """
    problem, state = freed(solution.problem, solution.state)
    params = problem.setup.params
    if not np.any(problem.obs.has_depth[problem.obs.shared]):
        raise CalibrationError(
            "structure free: no depth on the corners that cameras share, which alone gives free points their scale. "
            "Record depth, or take structure board"
        )
    history, iterations, settled = list(solution.course.history), solution.course.iterations, False
    for _ in range(params.max_rounds):
        problem, state, moved, done = _round(problem, state, len(solution.course.dropped))
        iterations, history = iterations + done[0], [*history, done[1]]
        if settled := moved < params.weight_tolerance:
            break
    message = _message(settled, params) + "; corners are free points"
    course = replace(solution.course, history=tuple(history), iterations=iterations, converged=settled, message=message)
    return _concluded(problem, state, course)


def freed(problem: Problem, state: State) -> tuple[Problem, State]:
    """The corners of frames that several cameras see as points of their own, and what can pose them.

    Corners that only one camera sees say nothing any more, and are left out.
    """
    obs, M = problem.obs, problem.setup.board.n_corners
    free = np.isin(np.arange(obs.n_frames), obs.frame[obs.shared])
    front = problem.board_corners_m(state)[0]
    number = obs.frame[:, None] * M + obs.corner
    seen = np.bincount(number[obs.has_pixel], minlength=len(free) * M)[number]
    told = ~obs.shared[:, None] | (seen >= 2)
    boards = Boards(state.boards.T_parent_board, free, se3.transform(state.boards.T_parent_board[:, None], front))
    masked = obs.keep(obs.has_pixel & told, obs.has_depth & told)
    return replace(problem, obs=masked, unit_size=boards.size), replace(state, boards=boards)


def _round(
    problem: Problem, state: State, n_dropped: int, precise: bool = True
) -> tuple[Problem, State, float, tuple[int, Round]]:
    """Solve and weigh once: what changed of the weights, and what to tell of it."""
    params = problem.setup.params
    tolerance = params.round_tolerance if precise else ROUGH_TOLERANCE
    minimum = solve.minimize(problem, state, params.max_iterations, tolerance)
    problem = replace(problem, wall_rays=_wall_rays(problem, minimum.state))
    with_fields = replace(problem, local=local_fields(problem, minimum.state))
    covariance = solve.covariance(with_fields, minimum.state)
    weights = reweighted(with_fields, minimum.state, covariance)
    tuned, change = with_fields.tuned(minimum.state, covariance)
    moved = max(problem.weights.change(weights), change)
    told = _told(minimum.cost, weights, n_dropped)
    return replace(tuned, weights=weights), minimum.state, moved, (minimum.iterations, told)


def _wall_rays(problem: Problem, state: State) -> FloatArray:
    """Rays (W, N, 2) of the cells of walls, by the lenses and the registration of a state."""
    walls, out = problem.setup.walls, problem.setup.wall_rays(state.intrinsics)
    for c in np.unique(walls.camera):
        mine = walls.camera == c
        out[mine] -= turn_of_rays(problem.blocks, state.values, int(c), walls.pixels_px[mine], walls.depth_m[mine])
    return out


def _concluded(problem: Problem, state: State, course: Course) -> Solution:
    """The last minimisation and what it says."""
    params = problem.setup.params
    final = solve.minimize(problem, state, params.max_iterations, params.tolerance)
    plain = solve.covariance(problem, final.state)
    seen = observability.examine(problem, plain)
    common = common_errors(problem, final.state, plain)
    covariance = solve.sandwich_covariance(problem, final.state, plain) + common.covariance
    covariance += covariance_of_sizes(problem, final.state, plain)
    course = replace(course, iterations=course.iterations + final.iterations)
    return Solution(problem, final.state, final.cost, plain, covariance, common, seen, course)


def _told(cost: float, weights: Weights, dropped_views: int) -> Round:
    return Round(
        cost,
        tuple(weights.sigma_2d_px.tolist()),
        tuple(weights.k_depth.tolist()),
        weights.cell_exponent,
        float(np.sqrt(np.mean(weights.ratio_pixel**2))),
        float(np.sqrt(np.mean(weights.ratio_depth**2))),
        dropped_views,
    )


def _message(settled: bool, params: BundleParams) -> str:
    return "Bundle adjustment converged" if settled else f"the weights still changed after {params.max_rounds} rounds"


def _check_left(problem: Problem, dropped: Mapping[tuple[str, str], str]) -> None:
    """Every camera must still be joined to the reference by frames that are left, and not by a few that agree by chance."""
    obs, cameras, instants = problem.obs, problem.setup.cameras, problem.instants()
    used = obs.has_pixel.any(axis=1) & obs.shared
    left, at_first = (np.bincount(obs.camera[v], minlength=len(cameras)) for v in (used, obs.shared))
    used &= (left >= MIN_SHARE_LEFT * at_first)[obs.camera]
    joined, grown = {cameras.index(problem.setup.reference)}, True
    while grown:
        pairs = [(int(f), int(c)) for f, c in zip(instants[used], obs.camera[used], strict=True)]
        together = {f for f, c in pairs if c in joined}
        more = {c for f, c in pairs if f in together}
        grown, joined = not more <= joined, joined | more
    priors = problem.setup.priors  # a depth camera that sees no corners goes with its colour camera
    lost = [name for i, name in enumerate(cameras) if i not in joined and priors[i].mount is None]
    if lost:
        why = "; ".join(
            f"{camera} frame {frame}: {text}" for (camera, frame), text in dropped.items() if camera in lost
        )
        raise CalibrationError(
            f"{', '.join(lost)}: too few views are left that agree with the other cameras ({why}); five common views are needed. "
            "The camera moved while the recording was made, its frames are of other instants or mirrored, or the board moved "
            "between exposures: fix the camera, hold the board still while all expose, and film again"
        )

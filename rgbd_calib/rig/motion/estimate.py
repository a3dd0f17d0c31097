"""From views with stamps to the clocks and, where it is not given, the rig: the bundle's rounds on a carried board."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rgbd_calib.geometry import spline
from rgbd_calib.geometry.banded import BAND
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig import bundle
from rgbd_calib.rig.blocks import ESTIMATED, Block
from rgbd_calib.rig.motion.boards import CarriedBoards
from rgbd_calib.rig.motion.clocks import OF_TIME
from rgbd_calib.rig.motion.problem import MotionProblem
from rgbd_calib.rig.motion.setup import ClockPrior, MotionSetup
from rgbd_calib.rig.observations import Walls, observe
from rgbd_calib.rig.problem import State
from rgbd_calib.rig.setup import BundleParams, CameraPrior, Setup
from rgbd_calib.rig.solution import Solution
from rgbd_calib.types import Board, Clock, PlacedView

KNOT_S = 0.05
"""Between knots: the period of the fastest tremor that is simulated, 6 Hz, has three. More knots cost little, since the motion's
prior fits them to the data."""


@dataclass(frozen=True)
class StampedView:
    """A view of the carried board with its stamps, s; of depth NaN where there is none."""

    placed: PlacedView
    color_s: float
    depth_s: float


def problem_of(
    carried: Sequence[StampedView],
    standing: Sequence[PlacedView],
    board: Board,
    priors: Mapping[str, CameraPrior],
    clocks: Mapping[str, ClockPrior],
    first_s: Mapping[str, float],
    T_world_color: Mapping[str, FloatArray],
    reference: str,
    params: BundleParams,
    walls: Walls | None = None,
    blocks: Sequence[type[Block]] = (*ESTIMATED, *OF_TIME),
    knot_s: float = KNOT_S,
) -> tuple[MotionProblem, State, tuple[str, ...], tuple[PlacedView, ...]]:
    """The problem, where it starts, the names of its frames, and all views in the order of its observations.

    Parameters
    ----------
    carried : views of the carried board, their faces read alike over time.
    standing : views of boards that stand, as for :func:`rgbd_calib.rig.bundle.bundle`.
    clocks, first_s : by camera, what is known of its clock, and its first stamp, s.
    """
    moving = [replace(v.placed, view=replace(v.placed.view, frame=frame_name(v.placed))) for v in carried]
    views = (*moving, *standing)
    obs, names = observe(views, board, {name: prior.depth_unit_m for name, prior in priors.items()})
    n, old = len(carried), obs.frame
    others = np.setdiff1d(np.arange(len(names)), old[:n])
    order = np.concatenate([old[:n], others])
    place = np.empty(len(names), int)
    place[order] = np.arange(len(names))
    obs = replace(obs, frame=place[old], shared=obs.shared | (place[old] < n))
    cameras = list(priors)
    base = Setup.of(priors, reference, T_world_color, board, obs, params, walls)
    color_s = np.array([v.color_s for v in carried])
    depth_s = np.array([v.depth_s if np.isfinite(v.depth_s) else v.color_s for v in carried])
    setup = MotionSetup(
        **{f: getattr(base, f) for f in base.__dataclass_fields__},
        color_s=color_s,
        depth_s=depth_s,
        camera_of=obs.camera[:n],
        first_s=np.array([first_s[c] for c in cameras]),
        clocks=tuple(clocks[c] for c in cameras),
        step_s=knot_s,
    )
    clock = np.array([[c.start.offset_s, c.start.drift_ppm] for c in setup.clocks])
    times = setup.times_s(clock, np.array([[c.start.depth_delay_s] for c in setup.clocks]))
    seen = np.array([not p.view.predicted for p in moving])
    poses = np.stack([T_world_color[p.view.camera] @ p.T_color_board for p in moving])
    path = through(times[0][seen], poses[seen], board, knot_s)
    setup = replace(setup, n_windows=path.n_windows)
    T_standing = np.tile(np.eye(4), (len(others), 1, 1))
    for placed, f, shared in zip(views, obs.frame, obs.shared, strict=True):
        if f >= n:
            T_standing[f - n] = (
                T_world_color[placed.view.camera] @ placed.T_color_board if shared else placed.T_color_board
            )
    problem = replace(MotionProblem.of(setup, blocks), unit_size=BAND)
    assert isinstance(problem, MotionProblem)
    boards = CarriedBoards.of(path, *times, T_standing)
    frames = tuple(names[k] for k in order)
    return problem, problem.start(boards), frames, views


def estimate(
    carried: Sequence[StampedView],
    standing: Sequence[PlacedView],
    board: Board,
    priors: Mapping[str, CameraPrior],
    clocks: Mapping[str, ClockPrior],
    first_s: Mapping[str, float],
    T_world_color: Mapping[str, FloatArray],
    reference: str,
    params: BundleParams | None = None,
    walls: Walls | None = None,
) -> Solution:
    """Solve for rig, clocks and motion together; as for :func:`problem_of`.

    Raises
    ------
    CalibrationError
        The equations are singular, or too few views are left.
    """
    args = (
        carried,
        standing,
        board,
        priors,
        clocks,
        first_s,
        T_world_color,
        reference,
        params or BundleParams(),
        walls,
    )
    problem, state, frames, views = problem_of(*args)
    return bundle.solved(problem, state, frames, views)


def clock_of(solution: Solution, camera: str) -> Clock:
    """What a solution says of a camera's clock, and of the delay of its depth, which may be a camera of its own."""
    i, values, C = solution.cameras.index(camera), solution.state.values, solution.covariance
    at = solution.index("clock", camera)
    offset, drift = values["clock"][i]
    delay_s = delay_var = 0.0
    problem = solution.problem
    assert isinstance(problem, MotionProblem)
    beside = [d for d, clock in zip(solution.cameras, problem.own.clocks, strict=True) if clock.beside == camera]
    if beside:
        other = solution.index("clock", beside[0])[0]
        delay_s = values["clock"][solution.cameras.index(beside[0]), 0] - offset
        delay_var = C[other, other] - 2 * C[other, at[0]] + C[at[0], at[0]]
    elif solution.has_depth[i]:
        own = solution.index("depth delay", camera)[0]
        delay_s, delay_var = values["depth delay"][i, 0], C[own, own]
    sds = np.sqrt(np.maximum([C[at[0], at[0]], C[at[1], at[1]], delay_var], 0.0)).tolist()
    return Clock(float(offset), float(drift), float(delay_s), float(values["readout"][i, 0]), 0.0, *sds)


def frame_name(placed: PlacedView) -> str:
    """Of a carried view: frames are each camera's own."""
    return f"{placed.view.camera} {placed.view.frame}"


def through(t_s: FloatArray, poses: FloatArray, board: Board, knot_s: float) -> spline.Spline:
    """A spline near poses (n, 4, 4) of the board at times (n,), any order."""
    order = np.argsort(t_s, kind="stable")
    middle = board.corners_m().mean(axis=0) * [1, 1, 0]
    return spline.through(t_s[order], poses[order], middle, knot_s)

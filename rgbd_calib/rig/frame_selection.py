"""Which frames of the board tell most: so many of a long recording that the rest adds little.

What a frame says of cameras, lenses and depth biases is its information with the board's pose eliminated (the Schur
complement of the bundle's equations, at the start and with its first weights). Frames are taken by greedy log det of the sum
(:mod:`rgbd_calib.geometry.selection`), after the few that keep a frame for each pair of cameras that has one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry.linear import IntArray, reduced_information
from rgbd_calib.geometry.selection import most_informative
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks import Kind
from rgbd_calib.rig.bundle import problem_of
from rgbd_calib.rig.observations import Walls
from rgbd_calib.rig.problem import Problem
from rgbd_calib.rig.setup import BundleParams, CameraPrior
from rgbd_calib.types import Board, PlacedView

POSE_SD = 1.0
"""Of what is known of a camera's pose before, rad and m: nothing; it keeps the matrix from being singular."""


@dataclass(frozen=True)
class FrameChoice:
    """The frames that tell most, and how sure they and all of them make the rig, by the equations at the start."""

    chosen: tuple[str, ...]
    left_out: tuple[str, ...]
    problem: Problem
    """At the start, with its first weights."""
    covariance: FloatArray
    """(P, P), of the problem's globals, with the chosen frames."""
    covariance_of_all: FloatArray
    """(P, P), with all frames."""


def choose_frames(
    views: Sequence[PlacedView],
    alone: Sequence[PlacedView],
    board: Board,
    priors: Mapping[str, CameraPrior],
    T_world_color: Mapping[str, FloatArray],
    reference: str,
    n: int,
    params: BundleParams | None = None,
    walls: Walls | None = None,
) -> FrameChoice:
    """`n` frames of `views`; `alone` are views of an intrinsic recording, which stay. The rest as for the bundle.

    Raises
    ------
    CalibrationError
        More frames are needed to keep every pair of cameras that has common views.
    """
    equations = _Equations(views, alone, board, priors, T_world_color, reference, params or BundleParams(), walls)
    frames = sorted({placed.view.frame for placed in views})
    index = {frame: i for i, frame in enumerate(equations.frames)}
    items = [index[frame] for frame in frames]
    extra = sorted(set(range(len(equations.frames))) - set(items))
    known = sum((equations.reduced(i) for i in extra), equations.known)
    first = _one_for_each_pair(views, frames)
    if len(first) > n:
        raise CalibrationError(
            f"--max-views {n}: {len(first)} frames are needed for one of each pair of cameras that has common views. "
            f"Allow {len(first)} or more"
        )
    chosen = most_informative(known, lambda k: equations.reduced(items[k]), len(frames), n, first)
    few = sum((equations.reduced(items[k]) for k in chosen), known)
    whole = sum((equations.reduced(i) for i in items), known)
    taken = tuple(frames[k] for k in chosen)
    return FrameChoice(
        taken,
        tuple(frame for frame in frames if frame not in set(taken)),
        equations.problem,
        equations.covariance(few),
        equations.covariance(whole),
    )


def _one_for_each_pair(views: Sequence[PlacedView], frames: Sequence[str]) -> list[int]:
    """Few frames that together have every pair of cameras that any frame has (greedy set cover, V. Chvatal, 1979)."""
    cameras: dict[str, list[str]] = {frame: [] for frame in frames}
    for placed in views:
        cameras[placed.view.frame].append(placed.view.camera)
    pairs = [set(combinations(sorted(cameras[frame]), 2)) for frame in frames]
    missing, out = set().union(*pairs), list[int]()
    while missing:
        best = max(range(len(frames)), key=lambda k: (len(pairs[k] & missing), -k))
        missing -= pairs[best]
        out.append(best)
    return out


class _Equations:
    """What every frame says at the start, put together when it is asked for."""

    def __init__(
        self,
        views: Sequence[PlacedView],
        alone: Sequence[PlacedView],
        board: Board,
        priors: Mapping[str, CameraPrior],
        T_world_color: Mapping[str, FloatArray],
        reference: str,
        params: BundleParams,
        walls: Walls | None,
    ) -> None:
        every = [*views, *alone]
        self.problem, self._state, self.frames = problem_of(
            every, board, priors, T_world_color, reference, params, walls
        )
        own = self.problem
        pose = np.zeros(own.n_globals, bool)
        pose[own.index("pose")] = True
        of_walls = own.data_equations(self._state, np.zeros(0, int), (Kind.WALL,))
        known = of_walls.plus_units(own.unit_information, np.zeros(own.unit_information.shape)).regular().reduced
        before = known + own.prior.information + np.diag(pose / POSE_SD**2)
        self._free = own.prior.free
        self.known: FloatArray = before[np.ix_(self._free, self._free)]
        """What is known without any frame, of the free parameters: priors, and the walls."""
        self._kept: dict[int, tuple[IntArray, FloatArray]] = {}

    def reduced(self, frame: int) -> FloatArray:
        """What a frame says of the free parameters, whatever its board's pose."""
        own = self.problem
        if frame not in self._kept:
            columns = own.pattern.columns[own.pattern.group[frame]]
            views = np.flatnonzero(own.obs.frame == frame)
            rows = (rows for _, _, rows in own.rows(self._state, views))
            self._kept[frame] = columns, reduced_information(rows, columns)
        columns, S = self._kept[frame]
        out = np.zeros((own.n_globals,) * 2)
        out[np.ix_(columns, columns)] = S
        return np.asarray(out[np.ix_(self._free, self._free)])

    def covariance(self, information: FloatArray) -> FloatArray:
        """(P, P), rows and columns of held parameters zero."""
        out = np.zeros((self.problem.n_globals,) * 2)
        out[np.ix_(self._free, self._free)] = np.linalg.inv(information)
        return out

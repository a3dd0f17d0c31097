"""Which face of the board, and which way up, each frame shows, where the print alone does not tell.

A checkerboard whose two sides are alike is read the same from both; the cameras of one frame tell the faces against each
other (:mod:`rgbd_calib.views.association`), but not which of the two is the front, and a view of one camera alone tells
nothing. As long as both sheets are perfect that is all the same. Real plates are bent and real sheets differ: a bow that is
hollow from the front is raised from the back, and frames that are read the wrong way round cancel it. So each frame takes the
reading that fits the board's shape best, as the nearest of few centres (k-means).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rgbd_calib.geometry.linear import IntArray
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.rig.blocks.block import Kind
from rgbd_calib.rig.observations import Observations
from rgbd_calib.rig.problem import Problem, State
from rgbd_calib.types import Board, PlacedView

POSE_STEPS = 2
"""Of Gauss and Newton, for the pose of a board that is read in another way: it moves by less than a millimetre."""
MIN_GAIN = 0.5
"""Of half the weighted sum of squares, that makes another reading the better one."""


@dataclass(frozen=True)
class Readings:
    """How else the frames could be read."""

    moves: tuple[tuple[bool, bool], ...]
    """(back, turned), the first of them neither: as it is read now."""
    of_frame: IntArray
    """(F,), which of them is best."""

    @property
    def n_changed(self) -> int:
        return int(np.count_nonzero(self.of_frame))


def ambiguous(board: Board) -> bool:
    """Can frames be read in more than one way?"""
    return len(_moves(board)) > 1


def best_readings(problem: Problem, state: State) -> Readings:
    """The best reading of each frame for the board's shape and the cameras as they are, the board's pose free.

    By the pixels alone: depth may have been taken at another instant.
    """
    moves, F = _moves(problem.setup.board), problem.setup.obs.n_frames
    costs = np.stack([_costs(*_posed(*read(problem, state, moves, np.full(F, k)))) for k in range(len(moves))])
    best = np.argmin(costs, axis=0)
    gained = costs[0] - costs[best, np.arange(F)] > MIN_GAIN
    return Readings(moves, np.where(gained, best, 0))


def read(
    problem: Problem, state: State, moves: Sequence[tuple[bool, bool]], of_frame: IntArray
) -> tuple[Problem, State]:
    """The problem with each frame read by its move (F,), and the boards where they were."""
    board, obs = problem.setup.board, problem.obs
    new, whole = (_read(board, o, moves, of_frame) for o in (obs, problem.setup.obs))
    setup = replace(problem.setup, obs=whole)
    back = np.stack([board.T_face_board(*move) for move in moves])[of_frame]
    boards = replace(state.boards, T_parent_board=state.boards.T_parent_board @ back)
    blocks = tuple(type(block)(setup) for block in problem.blocks)
    return replace(problem, setup=setup, obs=new, blocks=blocks), replace(state, boards=boards)


def read_views(
    views: Sequence[PlacedView], frames: IntArray, readings: Readings, board: Board
) -> tuple[PlacedView, ...]:
    """The same views as they are read then; `frames` (V,) has the frame of each."""
    out = []
    for placed, f in zip(views, frames, strict=True):
        back, turned = readings.moves[readings.of_frame[f]]
        T = placed.T_color_board @ board.T_face_board(back, turned)
        out.append(PlacedView(placed.view, placed.back ^ back, placed.turned ^ turned, T))
    return tuple(out)


def _moves(board: Board) -> tuple[tuple[bool, bool], ...]:
    backs, turns = ((False, True) if there else (False,) for there in (board.two_sided, board.symmetric))
    return tuple((back, turned) for back in backs for turned in turns)


def _read(board: Board, obs: Observations, moves: Sequence[tuple[bool, bool]], of_frame: IntArray) -> Observations:
    mine = of_frame[obs.frame]
    r, c = np.divmod(np.arange(board.n_corners), board.cols)
    numbers = []
    for back, turned in moves:
        row, col = (board.rows - 1 - r, board.cols - 1 - c) if turned else (r, c)
        numbers.append(row * board.cols + (board.cols - 1 - col if back else col))
    corner = np.stack(numbers)[mine[:, None], obs.corner]
    return replace(obs, back=obs.back ^ np.array([back for back, _ in moves], int)[mine], corner=corner)


def _posed(problem: Problem, state: State) -> tuple[Problem, State]:
    """With the boards' poses alone solved for."""
    for _ in range(POSE_STEPS):
        own = problem.data_equations(state, kinds=(Kind.PIXEL,)).regular()
        step = -np.einsum("fij,fj->fi", own.V_inv, own.unit_gradient)
        state = problem.moved(state, np.zeros(problem.n_globals), step)
    return problem, state


def _costs(problem: Problem, state: State) -> FloatArray:
    """(F,), half the weighted sum of squares of each frame's pixels."""
    of_pixel = problem.residuals(state)[0] * problem.weights.scales(problem.obs)[0][..., None]
    of_view = np.sum(of_pixel**2, axis=(1, 2))
    return np.asarray(0.5 * np.bincount(problem.obs.frame, of_view, minlength=problem.setup.obs.n_frames))

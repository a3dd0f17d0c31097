"""Boards that are not as they were stated, or read otherwise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.faults.common import Fault, Rng, change_views, named, second_camera
from rgbd_calib.simulation.session import Session, TrueScene, film, reprinted
from rgbd_calib.simulation.views import true_views
from rgbd_calib.types import Board, BoardView


@dataclass(frozen=True)
class Misshapen(Board):
    """A board whose corners are not where they should be."""

    wrong: Literal["bow", "s", "stretch"] = "bow"
    by: float = 0.0
    """Metres between the lowest and the highest corner, or a share of the width."""

    def corners_m(self, back: bool = False) -> FloatArray:
        """Corners (cols * rows, 3), as they are."""
        p = super().corners_m(back)
        x = 2 * p[:, 0] / ((self.cols - 1) * self.square_m) - 1
        y = 2 * p[:, 1] / ((self.rows - 1) * self.square_m) - 1
        if self.wrong == "stretch":
            return p * [1 + self.by, 1.0, 1.0]
        z = x**2 if self.wrong == "bow" else (x**3 - x) / 0.77 * np.cos(np.pi * y / 2)
        p[:, 2] += self.by * z
        return p


def _misshapen(board: Board, wrong: Literal["bow", "s", "stretch"], by: float) -> Misshapen:
    fields = {name: getattr(board, name) for name in Board.__dataclass_fields__}
    return Misshapen(**fields, wrong=wrong, by=by)


def _square(factor: float, bias: bool) -> Fault:
    def fault(scene: TrueScene, rng: Rng) -> Session:
        session = film(scene, rng, replace(scene.board, square_m=scene.board.square_m * factor))
        return session if bias else replace(session, walls=None)

    return fault


named("nothing")(film)
named("square stated 10 % too large")(_square(1.1, True))
named("square stated 10 % too large, no bias recording")(_square(1.1, False))
named("square stated 1 % too large (print at 99 %)")(_square(1.01, True))
named("square stated 1 % too large, no bias recording")(_square(1.01, False))
named("square in cm")(_square(100.0, True))


@named("print 1 % too wide")
def _stretched(scene: TrueScene, rng: Rng) -> Session:
    return film(replace(scene, board=_misshapen(scene.board, "stretch", 0.01)), rng, scene.board)


@named("board bent by 3 mm")
def _bent(scene: TrueScene, rng: Rng) -> Session:
    return film(replace(scene, board=_misshapen(scene.board, "bow", 0.003)), rng, scene.board)


@named("board bent to an S by 3 mm")
def _bent_s(scene: TrueScene, rng: Rng) -> Session:
    return film(replace(scene, board=_misshapen(scene.board, "s", 0.0015)), rng, scene.board)


@named("board bends by 3 mm, another way each time")
def _floppy(scene: TrueScene, rng: Rng) -> Session:
    session = film(scene, rng)
    views: list[BoardView] = []
    for frame, T in scene.boards.items():
        board = _misshapen(scene.board, "bow", rng.uniform(-0.003, 0.003))
        views += true_views(scene.rig, {frame: T}, board, scene.noise, rng)
    return replace(session, views=tuple(views))


@named("thickness stated 5 mm too small", ring=True)
def _thin(scene: TrueScene, rng: Rng) -> Session:
    return film(scene, rng, replace(scene.board, thickness_m=scene.board.thickness_m - 0.005))


@named("two_sided not stated", ring=True)
def _one_sided(scene: TrueScene, rng: Rng) -> Session:
    return film(scene, rng, replace(scene.board, two_sided=False, thickness_m=0.0))


@named("symmetric board, read from either end")
def _symmetric(scene: TrueScene, rng: Rng) -> Session:
    board = replace(scene.board, cols=10, square_m=0.055, shape=None)
    session = film(reprinted(scene, board, rng), rng)
    views = tuple(_half_turned(v, board) if rng.random() < 0.4 else v for v in session.views)
    return replace(session, views=views)


@named("symmetric board, upside down in one camera always")
def _upside_down(scene: TrueScene, rng: Rng) -> Session:
    board = replace(scene.board, cols=10, square_m=0.055, shape=None)
    session = film(reprinted(scene, board, rng), rng)
    return change_views(session, second_camera(scene), lambda v: _half_turned(v, board))


def _half_turned(view: BoardView, board: Board) -> BoardView:
    return replace(view, ids=board.n_corners - 1 - view.ids)


@named("a second board in view")
def _two_boards(scene: TrueScene, rng: Rng) -> Session:
    camera, session = second_camera(scene), film(scene, rng)
    aside = se3.retract(np.eye(4), np.array([0.1, 0.2, 0.1, 0.5, 0.1, 0.3]))
    others = {f: T @ aside for f, T in scene.boards.items()}
    rival = {v.frame: v for v in true_views(scene.rig, others, scene.board, scene.noise, rng) if v.camera == camera}
    return change_views(session, camera, lambda v: rival.get(v.frame, v) if rng.random() < 0.5 else v)


@named("columns and rows exchanged", ring=True)
def _exchanged(scene: TrueScene, rng: Rng) -> Session:
    board = replace(scene.board, cols=scene.board.rows, rows=scene.board.cols)

    def turned(view: BoardView) -> BoardView:
        r, c = np.divmod(view.ids, scene.board.cols)  # the same print by a quarter turn
        return replace(view, ids=c * board.cols + board.cols - 1 - r)

    session = film(scene, rng, board)
    assert session.close is not None
    return replace(session, views=tuple(map(turned, session.views)), close=tuple(map(turned, session.close)))


@named("one row too few stated")
def _row_too_few(scene: TrueScene, rng: Rng) -> Session:
    """The finder takes one board in eight for the smaller one (2 of 16 rendered images)."""
    board = replace(scene.board, rows=scene.board.rows - 1)

    def cut(view: BoardView) -> BoardView:
        kept = view.ids < board.n_corners
        arrays = {name: getattr(view, name)[kept] for name in ("ids", "corners_px", "depth_m", "depth_pixels")}
        return replace(view, **arrays)

    session = film(scene, rng, board)
    assert session.close is not None
    some = [tuple(cut(v) for v in views if rng.random() < 1 / 8) for views in (session.views, session.close)]
    return replace(session, views=some[0], close=some[1])

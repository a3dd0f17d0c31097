"""Boards that are not as they were stated, or read otherwise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.faults.common import Fault, Rng, change_views, named, second_camera
from rgbd_calib.simulation.poses import looks_at_back
from rgbd_calib.simulation.session import Session, TrueScene, film, film_close, reprinted
from rgbd_calib.simulation.views import true_views
from rgbd_calib.types import Board, BoardShape, BoardView


@dataclass(frozen=True)
class Misshapen(Board):
    """A board whose corners are not where they should be."""

    wrong: Literal["bow", "s", "stretch", "shear", "corner"] = "bow"
    by: float = 0.0
    """Metres between the lowest and the highest corner, a share of the width, radians, or metres of one corner."""

    def corners_m(self, back: bool = False) -> FloatArray:
        """Corners (cols * rows, 3), as they are."""
        p = super().corners_m(back)
        x = 2 * p[:, 0] / ((self.cols - 1) * self.square_m) - 1
        y = 2 * p[:, 1] / ((self.rows - 1) * self.square_m) - 1
        if self.wrong == "stretch":
            return p * [1 + self.by, 1.0, 1.0]
        if self.wrong == "shear":
            return p + np.outer(self.by * p[:, 1], [1.0, 0.0, 0.0])
        if self.wrong == "corner":
            p[self.cols + 2, 0] += self.by
            return p
        z = x**2 if self.wrong == "bow" else (x**3 - x) / 0.77 * np.cos(np.pi * y / 2)
        p[:, 2] += self.by * z
        return p


def _misshapen(board: Board, wrong: Literal["bow", "s", "stretch", "shear", "corner"], by: float) -> Misshapen:
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


named("print sheared by 0.5 deg")(
    lambda scene, rng: film(replace(scene, board=_misshapen(scene.board, "shear", np.radians(0.5))), rng, scene.board)
)
named("one corner of the print 4 mm off")(
    lambda scene, rng: film(replace(scene, board=_misshapen(scene.board, "corner", 0.004)), rng, scene.board)
)
named("board bent by 8 mm")(
    lambda scene, rng: film(replace(scene, board=_misshapen(scene.board, "bow", 0.008)), rng, scene.board)
)


@named("board bent by 3 mm in the intrinsic recording only")
def _leaning(scene: TrueScene, rng: Rng) -> Session:
    bent = replace(scene, board=_misshapen(scene.board, "bow", 0.003))
    return replace(film(scene, rng), close=film_close(bent, rng))


def _sees_back(scene: TrueScene, view: BoardView, T_world_board: FloatArray) -> bool:
    T = se3.inverse(scene.rig.cameras[view.camera].T_world_color) @ T_world_board
    return bool(looks_at_back(T, scene.board))


@named("the back glued upside down", ring=True)
def _glued(scene: TrueScene, rng: Rng) -> Session:
    session, close = film(scene, rng), {f: T for own in scene.close.values() for f, T in own.items()}
    assert session.close is not None

    def turned(view: BoardView, boards: Mapping[str, FloatArray]) -> BoardView:
        return _half_turned(view, scene.board) if _sees_back(scene, view, boards[view.frame]) else view

    return replace(
        session,
        views=tuple(turned(v, scene.boards) for v in session.views),
        close=tuple(turned(v, close) for v in session.close),
    )


@named("the back's print 5 mm beside the front's", ring=True)
def _beside(scene: TrueScene, rng: Rng) -> Session:
    r, c = np.divmod(np.arange(scene.board.n_corners), scene.board.cols)
    front, back = scene.board.corners_m(), scene.board.corners_m(back=True)
    behind = np.empty_like(back)
    behind[r * scene.board.cols + scene.board.cols - 1 - c] = back
    shaped = replace(scene.board, shape=BoardShape(front, behind + [0.004, -0.003, 0.0]))
    return film(replace(scene, board=shaped), rng)


@named("thickness stated ten times too large", ring=True)
def _thick(scene: TrueScene, rng: Rng) -> Session:
    return film(scene, rng, replace(scene.board, thickness_m=10 * scene.board.thickness_m))


@named("the last third of the frames with another board, squares 2 % smaller")
def _two_prints(scene: TrueScene, rng: Rng) -> Session:
    small = replace(scene.board, square_m=0.98 * scene.board.square_m, shape=None)
    late = list(scene.boards)[-(len(scene.boards) // 3) :]
    session = film(scene, rng)
    other = true_views(scene.rig, {f: scene.boards[f] for f in late}, small, scene.noise, rng)
    return replace(session, views=(*(v for v in session.views if v.frame not in late), *other))

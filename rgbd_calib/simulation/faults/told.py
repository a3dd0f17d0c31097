"""What people tell the program, wrongly: walls and their distances, lens files; and recordings that say little."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.faults.common import Fault, Rng, named, second_camera
from rgbd_calib.simulation.session import Session, TrueScene, draw_board, film, film_close
from rgbd_calib.simulation.views import ViewNoise, true_views


def _written(change: Callable[[FloatArray], FloatArray], one: bool) -> Fault:
    """Other distances (n,) of the walls, of the second camera or of all."""

    def fault(scene: TrueScene, rng: Rng) -> Session:
        session = film(scene, rng)
        assert session.walls is not None
        walls = dict(session.walls)
        for camera in [second_camera(scene)] if one else list(walls):
            rows = walls[camera].copy()
            rows[:, 1] = change(rows[:, 1])
            walls[camera] = rows
        return replace(session, walls=walls)

    return fault


named("wall distances of one camera in reverse order")(_written(lambda d: d[::-1], True))
named("wall distances rounded to 5 cm")(_written(lambda d: np.round(d / 0.05) * 0.05, False))
named("wall distances of one camera 1 % too long")(_written(lambda d: 1.01 * d, True))


@named("two walls only")
def _two_walls(scene: TrueScene, rng: Rng) -> Session:
    session = film(scene, rng)
    assert session.walls is not None
    cells = session.wall_cells
    return replace(
        session,
        walls={c: rows[[2, 6]] for c, rows in session.walls.items()},
        wall_cells=cells and {c: rows[[2, 6]] for c, rows in cells.items()},
    )


@named("the wall bulges by 6 mm")
def _bulging(scene: TrueScene, rng: Rng) -> Session:
    """The same wall every time, seen larger from near by."""
    session = film(scene, rng)
    assert session.walls is not None and session.wall_cells is not None
    cells = {}
    for camera, own in session.wall_cells.items():
        lens = scene.rig.cameras[camera].intrinsics
        moved = own.copy()
        for wall, z_m in zip(moved, session.walls[camera][:, 1], strict=True):
            at = z_m * lens.rays(wall[:, :2])[:, :2]
            wall[:, 2] -= 0.006 * np.exp(-np.sum(at**2, axis=1) / 0.8**2)
        cells[camera] = moved
    return replace(session, wall_cells=cells)


def _lens_file(change: Callable[[Intrinsics], Intrinsics]) -> Fault:
    """A file of intrinsics, the second camera's wrong."""

    def fault(scene: TrueScene, rng: Rng) -> Session:
        lenses = {c: own.intrinsics for c, own in scene.rig.cameras.items()}
        camera = second_camera(scene)
        return replace(film(scene, rng), close=None, lenses={**lenses, camera: change(lenses[camera])})

    return fault


named("intrinsics file: one camera's cx and cy exchanged")(_lens_file(lambda k: replace(k, cx=k.cy, cy=k.cx)))
named("intrinsics file: one camera's distortion with the other sign")(
    _lens_file(lambda k: replace(k, distortion=tuple(-v for v in k.distortion)))
)
named("intrinsics file: one camera's distortion left out")(
    _lens_file(lambda k: replace(k, distortion=(0.0,) * len(k.distortion)))
)
named("intrinsics file: one camera's focal length 8 % too large")(
    _lens_file(lambda k: replace(k, fx=1.08 * k.fx, fy=1.08 * k.fy))
)


def _boards(scene: TrueScene, range_m: tuple[float, float], rng: Rng, middle: bool = False) -> dict[str, FloatArray]:
    """As many boards as the scene has, each seen by two cameras at least."""
    out: dict[str, FloatArray] = {}
    names = list(scene.rig.cameras)
    while len(out) < len(scene.boards):
        own = names[len(out) % len(names)]
        T = draw_board(scene.rig, own, scene.board, range_m, rng)
        seen = true_views(scene.rig, {"": T}, scene.board, scene.noise, rng)
        lens = scene.rig.cameras[own].intrinsics
        off = [np.abs(v.corners_px.mean(axis=0) / lens.size_px - 0.5).max() for v in seen]
        if len(seen) >= 2 and (not middle or max(off) < 0.2):
            out[f"{len(out):06d}"] = T
    return out


@named("the board always in the middle of the images")
def _in_the_middle(scene: TrueScene, rng: Rng) -> Session:
    return film(replace(scene, boards=_boards(scene, (1.3, 2.9), rng, middle=True)), rng)


@named("the board always at 2 m")
def _one_distance(scene: TrueScene, rng: Rng) -> Session:
    return film(replace(scene, boards=_boards(scene, (1.95, 2.05), rng)), rng)


def _few(n: int, alone: bool) -> Fault:
    def fault(scene: TrueScene, rng: Rng) -> Session:
        session = film(replace(scene, boards={f: scene.boards[f] for f in list(scene.boards)[:n]}), rng)
        return replace(session, close=None, walls=None, wall_cells=None) if alone else session

    return fault


named("six frames")(_few(6, False))
named("eight frames, no other recording")(_few(8, True))


@named("no close views of one camera")
def _not_close(scene: TrueScene, rng: Rng) -> Session:
    session, camera = film(scene, rng), second_camera(scene)
    assert session.close is not None
    return replace(session, close=tuple(v for v in session.close if v.camera != camera))


@named("close views blurred, corners noisy by 1 px")
def _blurred_close(scene: TrueScene, rng: Rng) -> Session:
    noise = ViewNoise(1.0, scene.noise.k_depth_per_m, scene.noise.k_plane_per_m)
    return replace(film(scene, rng), close=film_close(replace(scene, noise=noise), rng))

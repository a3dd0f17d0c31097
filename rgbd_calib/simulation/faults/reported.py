"""What users of such cameras report: devices that change by themselves, mixed-up files, and other recordings that differ."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.faults.common import Rng, change_views, named, second_camera, with_depths, with_lens
from rgbd_calib.simulation.session import Session, TrueScene, film, film_close
from rgbd_calib.simulation.views import true_views
from rgbd_calib.types import Board, BoardShape, BoardView, DepthCamera


@named("no bias recording")
def _no_walls(scene: TrueScene, rng: Rng) -> Session:
    return replace(film(scene, rng), walls=None)


@named("depth magnified by 1 % in all cameras")
def _magnified(scene: TrueScene, rng: Rng) -> Session:
    cameras = {}
    for name, own in scene.rig.cameras.items():
        sensor = own.depth_sensor.camera
        lens = replace(sensor.intrinsics, fx=1.01 * sensor.intrinsics.fx, fy=1.01 * sensor.intrinsics.fy)
        cameras[name] = replace(own, depth_camera=DepthCamera(lens, sensor.T_color_depth))
    return film(replace(scene, rig=replace(scene.rig, cameras=cameras)), rng)


@named("the back's print 1 % larger than the front's", ring=True)
def _large_back(scene: TrueScene, rng: Rng) -> Session:
    board = scene.board
    front, back = board.corners_m(), board.corners_m(back=True)
    r, c = np.divmod(np.arange(board.n_corners), board.cols)
    behind = np.empty_like(back)
    behind[r * board.cols + board.cols - 1 - c] = back  # a shape is stored by the front's corner that it lies behind
    middle = behind.mean(axis=0)
    shaped = replace(board, shape=BoardShape(front, middle + 1.01 * (behind - middle)))
    return film(replace(scene, board=shaped), rng)


@named("one camera's depth images are those of the frame before")
def _late_depth(scene: TrueScene, rng: Rng) -> Session:
    session, camera = film(scene, rng), second_camera(scene)
    mine = [v for v in session.views if v.camera == camera]
    before = {v.frame: u for u, v in pairwise(mine)}

    def change(v: BoardView) -> BoardView:
        u = before.get(v.frame)
        return v if u is None else with_depths(v, u.depth_m)

    return change_views(session, camera, change)


@named("one camera's images are every third time those of the frame before")
def _frozen(scene: TrueScene, rng: Rng) -> Session:
    session, camera = film(scene, rng), second_camera(scene)
    mine = [v for v in session.views if v.camera == camera]
    stale = {v.frame: replace(u, frame=v.frame) for k, (u, v) in enumerate(pairwise(mine)) if k % 3 == 1}
    return change_views(session, camera, lambda v: stale.get(v.frame, v))


def _focused_anew(scene: TrueScene, boards: dict[str, FloatArray], by: float, rng: Rng) -> dict[str, BoardView]:
    """Views of the second camera, its focal length another one each time."""
    camera, out = second_camera(scene), {}
    lens = scene.rig.cameras[camera].intrinsics
    for frame, T in boards.items():
        f = 1 + rng.normal(0, by)
        rig = with_lens(scene.rig, camera, replace(lens, fx=f * lens.fx, fy=f * lens.fy))
        for v in true_views(rig, {frame: T}, scene.board, scene.noise, rng):
            if v.camera == camera:
                out[frame] = v
    return out


@named("autofocus: one camera's focal length varies by 0.5 % from frame to frame")
def _autofocus(scene: TrueScene, rng: Rng) -> Session:
    own = _focused_anew(scene, scene.boards, 0.005, rng)
    return change_views(film(scene, rng), second_camera(scene), lambda v: own.get(v.frame, v))


@named("autofocus in the intrinsic recording of one camera, 1 %")
def _autofocus_close(scene: TrueScene, rng: Rng) -> Session:
    camera, session = second_camera(scene), film(scene, rng)
    own = _focused_anew(scene, scene.close[camera], 0.01, rng)
    assert session.close is not None
    close = tuple(own.get(v.frame, v) if v.camera == camera else v for v in session.close)
    return replace(session, close=close)


@named("two cameras exchanged half-way")
def _exchanged(scene: TrueScene, rng: Rng) -> Session:
    """As where the system numbers devices anew."""
    session, (a, b), names = film(scene, rng), list(scene.rig.cameras)[:2], list(scene.boards)
    late, other = set(names[len(names) // 2 :]), {a: b, b: a}
    return replace(
        session,
        views=tuple(replace(v, camera=other.get(v.camera, v.camera)) if v.frame in late else v for v in session.views),
    )


@named("one camera's images upside down from the middle on")
def _turned_late(scene: TrueScene, rng: Rng) -> Session:
    camera, names = second_camera(scene), list(scene.boards)
    far = scene.rig.cameras[camera].intrinsics.size_px - 1
    late = set(names[len(names) // 2 :])
    return change_views(
        film(scene, rng), camera, lambda v: replace(v, corners_px=far - v.corners_px) if v.frame in late else v
    )


@named("all cameras' depth drifts by 0.5 % while it warms up")
def _all_warm(scene: TrueScene, rng: Rng) -> Session:
    session, at = film(scene, rng), {f: k / len(scene.boards) for k, f in enumerate(scene.boards)}
    for camera in scene.rig.cameras:
        session = change_views(session, camera, lambda v: with_depths(v, v.depth_m * (1 + 0.005 * at[v.frame])))
    return session


@named("intrinsic recording with a board of 2 % smaller squares")
def _other_board(scene: TrueScene, rng: Rng) -> Session:
    small = replace(scene.board, square_m=0.98 * scene.board.square_m, shape=None)
    about: Board = scene.board
    shift = se3.make(np.eye(3), about.corners_m().mean(axis=0) - small.corners_m().mean(axis=0))
    close = {c: {f: T @ shift for f, T in own.items()} for c, own in scene.close.items()}
    return replace(film(scene, rng), close=film_close(replace(scene, board=small, close=close), rng))


@named("wall distances in inches")
def _inches(scene: TrueScene, rng: Rng) -> Session:
    session = film(scene, rng)
    assert session.walls is not None
    return replace(session, walls={c: rows * [1, 39.37, 1] for c, rows in session.walls.items()})


@named("wall distances of one camera from its back, 4 cm too long")
def _from_the_back(scene: TrueScene, rng: Rng) -> Session:
    session, camera = film(scene, rng), second_camera(scene)
    assert session.walls is not None
    return replace(session, walls={**session.walls, camera: session.walls[camera] + [0, 0.04, 0]})


@named("a tenth of the depth readings are of what is behind the board")
def _behind(scene: TrueScene, rng: Rng) -> Session:
    def change(v: BoardView) -> BoardView:
        through = rng.random(len(v.ids)) < 0.1
        return with_depths(v, np.where(through, v.depth_m + rng.uniform(0.3, 1.5), v.depth_m))

    session = film(scene, rng)
    for camera in scene.rig.cameras:
        session = change_views(session, camera, change, close=True)
    return session

"""Instants that are not the same, and recordings that say too little."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.faults.common import Rng, change_views, named, second_camera
from rgbd_calib.simulation.session import Session, TrueScene, draw_board, film
from rgbd_calib.simulation.views import ViewNoise, true_views


@named("one clock 0.2 s late, the board moving at 0.15 m/s")
def _late(scene: TrueScene, rng: Rng) -> Session:
    camera = second_camera(scene)
    later = {}
    for f, T in scene.boards.items():
        way = rng.normal(size=3)
        step = np.concatenate([rng.normal(0, 0.1, 3) * 0.2, 0.15 * 0.2 * way / np.linalg.norm(way)])
        about = se3.make(np.eye(3), T[:3, 3])
        later[f] = about @ se3.retract(np.eye(4), step) @ se3.inverse(about) @ T
    late = {v.frame: v for v in true_views(scene.rig, later, scene.board, scene.noise, rng) if v.camera == camera}
    return change_views(film(scene, rng), camera, lambda v: late.get(v.frame, v))


@named("frames of one camera off by one")
def _off_by_one(scene: TrueScene, rng: Rng) -> Session:
    camera, names = second_camera(scene), list(scene.boards)
    after = dict(zip(names, names[1:] + names[:1], strict=True))
    return change_views(film(scene, rng), camera, lambda v: replace(v, frame=after[v.frame]))


@named("frames of one camera off by one from the middle on")
def _frame_lost(scene: TrueScene, rng: Rng) -> Session:
    camera, names = second_camera(scene), list(scene.boards)
    half = len(names) // 2
    rest = names[half:]
    after = dict(zip(rest, rest[1:] + rest[:1], strict=True))
    return change_views(film(scene, rng), camera, lambda v: replace(v, frame=after.get(v.frame, v.frame)))


@named("each instant copied six times")
def _copied(scene: TrueScene, rng: Rng) -> Session:
    names = list(scene.boards)[: max(len(scene.boards) // 6, 4)]
    few = replace(scene, boards={f: scene.boards[f] for f in names})
    session = film(few, rng)
    views = [replace(v, frame=f"{v.frame}_{k}") for v in session.views for k in range(6)]
    return replace(session, views=tuple(views))


@named("only two common frames of one camera")
def _two_frames(scene: TrueScene, rng: Rng) -> Session:
    camera, session = list(scene.rig.cameras)[-1], film(scene, rng)
    common = sorted({v.frame for v in session.views if v.camera == camera})[:2]
    return replace(session, views=tuple(v for v in session.views if v.camera != camera or v.frame in common))


@named("all views from one place")
def _one_place(scene: TrueScene, rng: Rng) -> Session:
    T = max(scene.boards.values(), key=lambda T: len(true_views(scene.rig, {"x": T}, scene.board, scene.noise, rng)))
    about = T @ se3.make(np.eye(3), scene.board.corners_m().mean(axis=0))
    turn = {f: rng.normal(0, 0.03, 6) * [1, 1, 1, 0.3, 0.3, 0.3] for f in scene.boards}
    boards = {f: about @ se3.retract(np.eye(4), x) @ se3.inverse(about) @ T for f, x in turn.items()}
    return film(replace(scene, boards=boards), rng)


def _square_on(scene: TrueScene, rng: Rng) -> TrueScene:
    """The same places, the board square to the first camera that sees it."""
    boards = {}
    for f, T in scene.boards.items():
        own = scene.rig.cameras[true_views(scene.rig, {f: T}, scene.board, scene.noise, rng)[0].camera].T_world_color
        middle = se3.transform(T, scene.board.corners_m().mean(axis=0)[None])[0]
        R = own[:3, :3]
        boards[f] = se3.make(R, middle - R @ scene.board.corners_m().mean(axis=0))
    return replace(scene, boards=boards)


@named("every board square to a camera")
def _fronto(scene: TrueScene, rng: Rng) -> Session:
    return film(_square_on(scene, rng), rng)


@named("every board square to a camera, no other recording")
def _fronto_alone(scene: TrueScene, rng: Rng) -> Session:
    return replace(film(_square_on(scene, rng), rng), close=None, walls=None)


@named("close views all square to the camera")
def _fronto_close(scene: TrueScene, rng: Rng) -> Session:
    close: dict[str, dict[str, FloatArray]] = {}
    for name, boards in scene.close.items():
        close[name] = {f: draw_board(scene.rig, name, scene.board, (0.8, 1.2), rng, 0.01) for f in boards}
    return film(replace(scene, close=close), rng)


@named("no other recording")
def _alone(scene: TrueScene, rng: Rng) -> Session:
    return replace(film(scene, rng), close=None, walls=None)


@named("corners noisy by 1.5 px")
def _noisy(scene: TrueScene, rng: Rng) -> Session:
    return film(replace(scene, noise=ViewNoise(1.5, scene.noise.k_depth_per_m, scene.noise.k_plane_per_m)), rng)


@named("depth noisy by 60 mm at 2 m")
def _noisy_depth(scene: TrueScene, rng: Rng) -> Session:
    return film(replace(scene, noise=ViewNoise(scene.noise.sigma_2d_px, 15e-3, 3e-3)), rng)


@named("a tenth of the boards moved between two cameras' exposures")
def _hasty(scene: TrueScene, rng: Rng) -> Session:
    late = _late(scene, rng)
    moved = {v.frame for v in late.views if rng.random() < 0.1}
    still = film(scene, rng)
    by_key = {(v.camera, v.frame): v for v in late.views}
    return replace(still, views=tuple(by_key[v.camera, v.frame] if v.frame in moved else v for v in still.views))


@named("time stamps of one camera wrong by 0.2 s")
def _wrong_stamps(scene: TrueScene, rng: Rng) -> Session:
    return replace(film(scene, rng), late_stamps_us=2e5)

"""Depth cameras as they misbehave: rays for depth, mixed readings, other projectors, steps, changes in the middle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.faults.common import Fault, Rng, change_views, named, second_camera, with_depths
from rgbd_calib.simulation.session import Session, TrueScene, film
from rgbd_calib.types import BoardView

Depths = Callable[[BoardView, TrueScene, Rng], FloatArray]


def _everywhere(change: Depths, one: bool) -> Fault:
    """The depth of all views of the second camera, or of every camera, close views too."""

    def fault(scene: TrueScene, rng: Rng) -> Session:
        session = film(scene, rng)
        for camera in [second_camera(scene)] if one else list(scene.rig.cameras):
            session = change_views(session, camera, lambda v: with_depths(v, change(v, scene, rng)), close=True)
        return session

    return fault


def _along_rays(v: BoardView, scene: TrueScene, rng: Rng) -> FloatArray:
    return v.depth_m * np.linalg.norm(scene.rig.cameras[v.camera].intrinsics.rays(v.corners_px), axis=1)


named("one camera's depth along its rays, not its axis")(_everywhere(_along_rays, True))
named("all cameras' depth along their rays, not their axes")(_everywhere(_along_rays, False))


def _mixed(v: BoardView, scene: TrueScene, rng: Rng) -> FloatArray:
    r, c = np.divmod(v.ids, scene.board.cols)
    border = (r == 0) | (c == 0) | (r == scene.board.rows - 1) | (c == scene.board.cols - 1)
    return v.depth_m + np.where(border, rng.exponential(0.03, len(v.ids)), 0.0)


named("depth at the board's border mixed with what is behind")(_everywhere(_mixed, False))


def _half_missing(v: BoardView, scene: TrueScene, rng: Rng) -> FloatArray:
    return np.where(rng.random() < 0.5, np.nan, v.depth_m)


named("no depth in half of the views")(_everywhere(_half_missing, False))


def _other_projectors(v: BoardView, scene: TrueScene, rng: Rng) -> FloatArray:
    return v.depth_m + np.where(rng.random(len(v.ids)) < 1 / 3, rng.normal(0, 0.02, len(v.ids)), 0.0)


named("other projectors: a third of the depth readings noisy by 20 mm")(_everywhere(_other_projectors, False))
named("depth in steps of 5 mm, rounded down")(_everywhere(lambda v, s, r: np.floor(v.depth_m / 0.005) * 0.005, False))
named("no depth beyond 2 m")(_everywhere(lambda v, s, r: np.where(v.depth_m > 2, np.nan, v.depth_m), False))


@named("all cameras' depth 30 mm too long, no bias recording")
def _too_long(scene: TrueScene, rng: Rng) -> Session:
    session = _everywhere(lambda v, s, r: v.depth_m + 0.03, False)(scene, rng)
    cameras = {}
    for name, own in scene.rig.cameras.items():
        assert own.depth_bias is not None
        c = own.depth_bias.coefficients
        cameras[name] = replace(own, depth_bias=replace(own.depth_bias, coefficients=(c[0] - 0.03, *c[1:])))
    return replace(session, truth=replace(scene.rig, cameras=cameras), walls=None, wall_cells=None)


@named("one camera's depth 20 mm longer than when the walls were filmed")
def _longer_since(scene: TrueScene, rng: Rng) -> Session:
    session, camera = film(scene, rng), second_camera(scene)
    own = scene.rig.cameras[camera]
    assert own.depth_bias is not None
    c = own.depth_bias.coefficients
    now = replace(own, depth_bias=replace(own.depth_bias, coefficients=(c[0] - 0.02, *c[1:])))
    truth = replace(scene.rig, cameras={**scene.rig.cameras, camera: now})
    return replace(change_views(session, camera, lambda v: with_depths(v, v.depth_m + 0.02), close=True), truth=truth)


def _half_way(change: Callable[[FloatArray], FloatArray]) -> Fault:
    """The second camera's depth from the middle on."""

    def fault(scene: TrueScene, rng: Rng) -> Session:
        names = list(scene.boards)
        late = set(names[len(names) // 2 :])
        return change_views(
            film(scene, rng),
            second_camera(scene),
            lambda v: with_depths(v, change(v.depth_m)) if v.frame in late else v,
        )

    return fault


named("one camera's depth 1 % longer from the middle on")(_half_way(lambda z: 1.01 * z))
named("one camera's disparity shifts by 0.15 px half-way")(_half_way(lambda z: 1 / (1 / z - 0.15 / (580 * 0.075))))


@named("one camera's depth averaged with the frame before")
def _smeared(scene: TrueScene, rng: Rng) -> Session:
    session, camera = film(scene, rng), second_camera(scene)
    before = {v.frame: u.depth_m for u, v in pairwise([v for v in session.views if v.camera == camera])}
    return change_views(
        session, camera, lambda v: with_depths(v, (v.depth_m + before[v.frame]) / 2) if v.frame in before else v
    )


@named("one camera's depth images are another camera's")
def _anothers(scene: TrueScene, rng: Rng) -> Session:
    session, (a, b) = film(scene, rng), list(scene.rig.cameras)[:2]
    other = {v.frame: v.depth_m for v in session.views if v.camera == a}
    return change_views(session, b, lambda v: with_depths(v, other[v.frame]) if v.frame in other else v)

"""Depth that is not what it says, and bias recordings that are not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rgbd_calib.geometry.depth_error import GridField
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.faults.common import (
    Fault,
    Rng,
    change_views,
    named,
    second_camera,
    swapped_walls,
    with_depths,
)
from rgbd_calib.simulation.session import Session, TrueScene, film
from rgbd_calib.types import BoardView


def _scaled_depth(factor: float, one: bool) -> Fault:
    def fault(scene: TrueScene, rng: Rng) -> Session:
        session = film(scene, rng)
        for camera in [second_camera(scene)] if one else list(scene.rig.cameras):
            session = change_views(session, camera, lambda v: with_depths(v, v.depth_m * factor), close=True)
        return session

    return fault


named("depth in 0.1 mm, stated as mm")(_scaled_depth(10.0, False))
named("depth of one camera in 0.1 mm, stated as mm")(_scaled_depth(10.0, True))


def _with_bias(scene: TrueScene, slope: float) -> TrueScene:
    """The second camera's depth is too long by this share."""
    camera = second_camera(scene)
    own = scene.rig.cameras[camera]
    assert own.depth_bias is not None
    c = own.depth_bias.coefficients
    bias = replace(own.depth_bias, coefficients=(c[0], c[1] - slope, *c[2:]))
    return replace(scene, rig=replace(scene.rig, cameras={**scene.rig.cameras, camera: replace(own, depth_bias=bias)}))


@named("depth of one camera 3 % too long")
def _long(scene: TrueScene, rng: Rng) -> Session:
    return film(_with_bias(scene, 0.03), rng)


@named("depth of one camera 3 % longer than when the walls were filmed")
def _longer(scene: TrueScene, rng: Rng) -> Session:
    before = film(scene, rng)
    return replace(film(_with_bias(scene, 0.03), rng), walls=before.walls, wall_cells=before.wall_cells)


def _shifted_depth(view: BoardView, shift_px: FloatArray) -> BoardView:
    """The depth of the board's plane at pixels (n, 2) beside the corners."""
    A = np.column_stack([view.corners_px, np.ones(len(view.ids))])
    ok = np.isfinite(view.depth_m)
    if ok.sum() < 4:
        return view
    slope = np.linalg.lstsq(A[ok], 1 / view.depth_m[ok], rcond=None)[0][:2]
    return with_depths(view, 1 / (1 / view.depth_m + shift_px @ slope))


@named("depth of one camera 10 px beside its colour")
def _unregistered(scene: TrueScene, rng: Rng) -> Session:
    def change(v: BoardView) -> BoardView:
        return _shifted_depth(v, np.tile([10.0, 0.0], (len(v.ids), 1)))

    return change_views(film(scene, rng), second_camera(scene), change, close=True)


@named("depth not registered to colour, 25 mm apart, all cameras")
def _baseline(scene: TrueScene, rng: Rng) -> Session:
    session = film(scene, rng)
    for camera, own in scene.rig.cameras.items():
        fx = own.intrinsics.fx

        def change(v: BoardView, fx: float = fx) -> BoardView:
            shift = 0.025 * fx / np.where(np.isfinite(v.depth_m), v.depth_m, 1.0)
            return _shifted_depth(v, np.stack([shift, 0 * shift], axis=1))

        session = change_views(session, camera, change, close=True)
    return session


@named("one camera without depth")
def _blind(scene: TrueScene, rng: Rng) -> Session:
    return change_views(
        film(scene, rng), second_camera(scene), lambda v: with_depths(v, np.full(len(v.ids), np.nan)), close=True
    )


@named("holes in one camera's depth")
def _holes(scene: TrueScene, rng: Rng) -> Session:
    def change(v: BoardView) -> BoardView:
        return with_depths(v, np.where(rng.random(len(v.ids)) < 0.6, np.nan, v.depth_m))

    return change_views(film(scene, rng), second_camera(scene), change, close=True)


@named("one camera's depth saturated at 1.8 m")
def _saturated(scene: TrueScene, rng: Rng) -> Session:
    return change_views(
        film(scene, rng), second_camera(scene), lambda v: with_depths(v, np.minimum(v.depth_m, 1.8)), close=True
    )


@named("depth through 8 bits (steps of 20 mm)")
def _lossy(scene: TrueScene, rng: Rng) -> Session:
    session = film(scene, rng)
    for camera in scene.rig.cameras:
        session = change_views(session, camera, lambda v: with_depths(v, np.round(v.depth_m / 0.02) * 0.02), close=True)
    return session


@named("one camera's depth drifts by 0.5 % while it warms up")
def _drift(scene: TrueScene, rng: Rng) -> Session:
    at = {f: k / len(scene.boards) for k, f in enumerate(scene.boards)}

    def change(v: BoardView) -> BoardView:
        return with_depths(v, v.depth_m * (1 + 0.005 * at[v.frame]))

    return change_views(film(scene, rng), second_camera(scene), change)


def _with_field(scene: TrueScene) -> TrueScene:
    """The second camera's depth errs by 10 mm at 2 m more, over its image."""
    camera = second_camera(scene)
    own = scene.rig.cameras[camera]
    lens, grid = own.intrinsics, own.depth_field
    if not isinstance(grid, GridField):
        axes = np.linspace(0, lens.width, 33), np.linspace(0, lens.height, 25), np.array([0.3, 6.0])
        grid = GridField(*axes, np.zeros([len(axis) for axis in axes]))
    u, v, z = np.meshgrid(grid.u_px, grid.v_px, grid.z_m, indexing="ij")
    x, y = 2 * u / lens.width - 1, 2 * v / lens.height - 1
    other = replace(own, depth_field=replace(grid, error=grid.error - 0.005 * (x * x - y) * z))
    return replace(scene, rig=replace(scene.rig, cameras={**scene.rig.cameras, camera: other}))


@named("one camera's depth off by a field over the image (10 mm at 2 m)")
def _field(scene: TrueScene, rng: Rng) -> Session:
    return film(_with_field(scene), rng)


@named("a field over one camera's depth since the walls were filmed (10 mm at 2 m)")
def _field_since(scene: TrueScene, rng: Rng) -> Session:
    before = film(scene, rng)
    return replace(film(_with_field(scene), rng), walls=before.walls, wall_cells=before.wall_cells)


def _walls(change: Callable[[dict[str, FloatArray], TrueScene], dict[str, FloatArray]]) -> Fault:
    def fault(scene: TrueScene, rng: Rng) -> Session:
        session = film(scene, rng)
        assert session.walls is not None
        return replace(session, walls=change(dict(session.walls), scene))

    return fault


@named("depth bias of another camera")
def _other_bias(scene: TrueScene, rng: Rng) -> Session:
    a, b = list(scene.rig.cameras)[:2]
    return swapped_walls(film(scene, rng), {b: a})


@named("one wall distance mistyped (1.2 as 2.1)")
@_walls
def _mistyped(walls: dict[str, FloatArray], scene: TrueScene) -> dict[str, FloatArray]:
    rows = walls[second_camera(scene)].copy()
    rows[2, 1] = 2.1
    return {**walls, second_camera(scene): rows}


@named("one wall distance mistyped by 5 cm")
@_walls
def _mistyped_little(walls: dict[str, FloatArray], scene: TrueScene) -> dict[str, FloatArray]:
    rows = walls[second_camera(scene)].copy()
    rows[4, 1] += 0.05
    return {**walls, second_camera(scene): rows}


@named("all wall distances 5 cm too long")
@_walls
def _offset(walls: dict[str, FloatArray], scene: TrueScene) -> dict[str, FloatArray]:
    return {c: rows + [0, 0.05, 0] for c, rows in walls.items()}


@named("wall distances in cm")
@_walls
def _in_cm(walls: dict[str, FloatArray], scene: TrueScene) -> dict[str, FloatArray]:
    return {c: rows * [1, 100, 1] for c, rows in walls.items()}


@named("wall distances of one camera along its rays, 15 deg tilted")
@_walls
def _slant(walls: dict[str, FloatArray], scene: TrueScene) -> dict[str, FloatArray]:
    return {**walls, second_camera(scene): walls[second_camera(scene)] * [1, 1 / np.cos(np.radians(15)), 1]}

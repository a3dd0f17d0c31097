"""Mounts that give way, images that move in their frame, and instants that are spread over an exposure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.faults.common import (
    Fault,
    Rng,
    change_views,
    changed_half_way,
    moved_rig,
    named,
    second_camera,
    with_lens,
    with_pixels,
)
from rgbd_calib.simulation.session import Session, TrueScene, film, film_close
from rgbd_calib.simulation.views import true_views
from rgbd_calib.types import BoardView, Rig

BUMP = np.array([0, np.radians(0.5), 0, 0.004, 0.003, 0])
"""rad, m."""


def _by_rigs(scene: TrueScene, rigs: Mapping[str, Rig], rng: Rng) -> Session:
    """The session whose frame f was filmed by rigs[f]."""
    views = [v for f, rig in rigs.items() for v in true_views(rig, {f: scene.boards[f]}, scene.board, scene.noise, rng)]
    return replace(film(scene, rng), views=tuple(views))


@named("a camera sags by 3 mm over the session")
def _sags(scene: TrueScene, rng: Rng) -> Session:
    camera, n = second_camera(scene), len(scene.boards)
    fall = np.array([np.radians(0.05), 0, 0, 0, 0.003, 0])
    rigs = {f: moved_rig(scene.rig, camera, (1 - k / (n - 1)) * -fall) for k, f in enumerate(scene.boards)}
    return _by_rigs(scene, rigs, rng)


@named("every camera shakes by 1 mm from frame to frame")
def _shakes(scene: TrueScene, rng: Rng) -> Session:
    rigs = {}
    for f in scene.boards:
        rig = scene.rig
        for camera in scene.rig.cameras:
            rig = moved_rig(rig, camera, rng.normal(0, [3e-4, 3e-4, 3e-4, 6e-4, 6e-4, 6e-4]))
        rigs[f] = rig
    return _by_rigs(scene, rigs, rng)


@named("all cameras mounted anew half-way")
def _mounted_anew(scene: TrueScene, rng: Rng) -> Session:
    rig = scene.rig
    for camera in list(rig.cameras)[1:]:
        rig = moved_rig(rig, camera, rng.normal(0, [0.05, 0.05, 0.05, 0.03, 0.03, 0.03]))
    return changed_half_way(scene, rig, rng)


def _bumped_at(first: int, last: int) -> Fault:
    """The second camera is displaced in the `first` frames at the start and the `last` at the end."""

    def fault(scene: TrueScene, rng: Rng) -> Session:
        names, moved = list(scene.boards), moved_rig(scene.rig, second_camera(scene), BUMP)
        elsewhere = {*names[:first], *names[len(names) - last :]}
        return _by_rigs(scene, {f: moved if f in elsewhere else scene.rig for f in names}, rng)

    return fault


named("a camera bumped after the first three frames, 5 mm and 0.5 deg")(_bumped_at(3, 0))
named("a camera elsewhere in the last three frames, 5 mm and 0.5 deg")(_bumped_at(0, 3))


@named("the reference refocused half-way (1 % of focal length)")
def _reference_refocused(scene: TrueScene, rng: Rng) -> Session:
    camera = scene.rig.reference
    lens = scene.rig.cameras[camera].intrinsics
    return changed_half_way(
        scene, with_lens(scene.rig, camera, replace(lens, fx=1.01 * lens.fx, fy=1.01 * lens.fy)), rng
    )


@named("image stabilisation: one camera's image centre moves by 3 px from frame to frame")
def _stabilised(scene: TrueScene, rng: Rng) -> Session:
    return change_views(
        film(scene, rng), second_camera(scene), lambda v: replace(v, corners_px=v.corners_px + rng.normal(0, 3, 2))
    )


@named("one camera's image centre 4 px elsewhere since the intrinsic recording")
def _centre_moved(scene: TrueScene, rng: Rng) -> Session:
    camera, by = second_camera(scene), np.array([4.0, -3.0])
    session = change_views(film(scene, rng), camera, lambda v: replace(v, corners_px=v.corners_px + by))
    return replace(session, truth=with_pixels(scene.rig, camera, 1.0, by))


@named("one camera's images undistorted, those of the intrinsic recording not")
def _undistorted(scene: TrueScene, rng: Rng) -> Session:
    camera = second_camera(scene)
    lens = scene.rig.cameras[camera].intrinsics
    straight = replace(lens, distortion=(0.0,) * len(lens.distortion))
    now = replace(scene, rig=with_lens(scene.rig, camera, straight))
    return replace(film(now, rng), close=film_close(scene, rng))


@named("one camera's images half a pixel aside, from scaling")
def _half_a_pixel(scene: TrueScene, rng: Rng) -> Session:
    camera, by = second_camera(scene), np.array([0.5, 0.5])
    session = change_views(film(scene, rng), camera, lambda v: replace(v, corners_px=v.corners_px + by), close=True)
    return replace(session, truth=with_pixels(scene.rig, camera, 1.0, by))


@named("one camera frozen from the middle on")
def _frozen(scene: TrueScene, rng: Rng) -> Session:
    session, camera, names = film(scene, rng), second_camera(scene), list(scene.boards)
    late = set(names[len(names) // 2 :])
    last = [v for v in session.views if v.camera == camera and v.frame not in late][-1]
    return change_views(session, camera, lambda v: replace(last, frame=v.frame) if v.frame in late else v)


def _carried_on(scene: TrueScene, seconds: float, speed_m_s: float, rng: Rng) -> dict[str, FloatArray]:
    """T_world_board of each frame a moment later, each moving its own way."""
    out = {}
    for f, T in scene.boards.items():
        way = rng.normal(size=3)
        out[f] = se3.make(np.eye(3), seconds * speed_m_s * way / np.linalg.norm(way)) @ T
    return out


@named("rolling shutter of 20 ms, the board moving at 0.3 m/s")
def _rolling(scene: TrueScene, rng: Rng) -> Session:
    session, later = film(scene, rng), _carried_on(scene, 0.02, 0.3, rng)
    quiet = replace(scene.noise, sigma_2d_px=0.0)
    ends = {(v.camera, v.frame): v.corners_px for v in true_views(scene.rig, later, scene.board, quiet, rng)}
    starts = {(v.camera, v.frame): v.corners_px for v in true_views(scene.rig, scene.boards, scene.board, quiet, rng)}

    def read_out(v: BoardView) -> BoardView:
        key, height = (v.camera, v.frame), scene.rig.cameras[v.camera].intrinsics.height
        if key not in starts or key not in ends:
            return v
        return replace(v, corners_px=v.corners_px + (ends[key] - starts[key]) * (v.corners_px[:, 1:] / height - 0.5))

    for camera in scene.rig.cameras:
        session = change_views(session, camera, read_out)
    return session


@named("the board moves by 2 mm between the cameras' exposures, in every frame")
def _never_still(scene: TrueScene, rng: Rng) -> Session:
    views: list[BoardView] = []
    for camera in scene.rig.cameras:
        alone = replace(scene.rig, cameras={camera: scene.rig.cameras[camera]}, reference=camera)
        views += true_views(alone, _carried_on(scene, 1.0, 0.002, rng), scene.board, scene.noise, rng)
    return replace(film(scene, rng), views=tuple(views))

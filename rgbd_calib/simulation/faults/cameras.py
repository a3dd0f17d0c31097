"""Cameras and lenses that are not what they were, or not where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.faults.common import (
    Fault,
    Rng,
    change_views,
    changed_half_way,
    moved_rig,
    named,
    second_camera,
    swapped_walls,
    with_lens,
    with_pixels,
)
from rgbd_calib.simulation.lenses import color_lens
from rgbd_calib.simulation.session import Session, TrueScene, draw_board, film, film_close
from rgbd_calib.simulation.views import true_views
from rgbd_calib.types import Board, BoardView


@named("cameras swapped in the intrinsic recording")
def _swapped(scene: TrueScene, rng: Rng) -> Session:
    session, (a, b) = film(scene, rng), list(scene.rig.cameras)[:2]
    names = {a: b, b: a}
    assert session.close is not None
    return replace(session, close=tuple(replace(v, camera=names.get(v.camera, v.camera)) for v in session.close))


@named("cameras swapped in the rig's recording")
def _swapped_all(scene: TrueScene, rng: Rng) -> Session:
    session, (a, b) = _swapped(scene, rng), list(scene.rig.cameras)[:2]
    return swapped_walls(session, {a: b, b: a})


def _mirrored(view: BoardView, board: Board, width: int) -> BoardView:
    """A mirrored print is the same print upside down, so that the detector reads its rows from below."""
    r, c = np.divmod(view.ids, board.cols)
    return replace(
        view, ids=(board.rows - 1 - r) * board.cols + c, corners_px=view.corners_px * [-1, 1] + [width - 1, 0]
    )


@named("one camera's images mirrored")
def _mirror(scene: TrueScene, rng: Rng) -> Session:
    camera = second_camera(scene)
    width = scene.rig.cameras[camera].intrinsics.width
    return change_views(film(scene, rng), camera, lambda v: _mirrored(v, scene.board, width), close=True)


@named("one camera's images upside down, its intrinsics not")
def _rotated(scene: TrueScene, rng: Rng) -> Session:
    camera = second_camera(scene)
    far = scene.rig.cameras[camera].intrinsics.size_px - 1
    session = change_views(film(scene, rng), camera, lambda v: replace(v, corners_px=far - v.corners_px))
    return replace(session, truth=with_pixels(scene.rig, camera, -1.0, far, roll=True))


@named("one camera's images cropped by 3 % and enlarged")
def _cropped(scene: TrueScene, rng: Rng) -> Session:
    camera, s, at = second_camera(scene), 1.03, np.array([6.0, 9.0])
    session = change_views(film(scene, rng), camera, lambda v: replace(v, corners_px=s * (v.corners_px - at)))
    return replace(session, truth=with_pixels(scene.rig, camera, s, -s * at))


def _bumped(xi: FloatArray, which: int) -> Fault:
    def fault(scene: TrueScene, rng: Rng) -> Session:
        return changed_half_way(scene, moved_rig(scene.rig, list(scene.rig.cameras)[which], xi), rng)

    return fault


named("a camera bumped half-way, 5 mm and 0.5 deg")(_bumped(np.array([0, np.radians(0.5), 0, 0.004, 0.003, 0]), 1))
named("a camera bumped half-way, 2 mm")(_bumped(np.array([0, 0, 0, 0.0012, 0, 0.0016]), 1))
named("a camera turned by 90 deg half-way")(_bumped(np.array([0, 0, np.pi / 2, 0, 0, 0]), 1))
named("the reference bumped half-way, 5 mm and 0.5 deg")(_bumped(np.array([np.radians(0.5), 0, 0, 0, 0.003, 0.004]), 0))


@named("two cameras bumped half-way, together")
def _two_bumped(scene: TrueScene, rng: Rng) -> Session:
    rig = scene.rig
    for camera in list(rig.cameras)[1:3]:
        rig = moved_rig(rig, camera, np.array([0, np.radians(0.4), 0, 0.004, 0.003, 0]))
    return changed_half_way(scene, rig, rng)


def _zoomed(lens: Intrinsics, by: float) -> Intrinsics:
    return replace(lens, fx=lens.fx * by, fy=lens.fy * by)


@named("a lens refocused half-way (1 % of focal length)")
def _refocused(scene: TrueScene, rng: Rng) -> Session:
    camera = second_camera(scene)
    lens = _zoomed(scene.rig.cameras[camera].intrinsics, 1.01)
    return changed_half_way(scene, with_lens(scene.rig, camera, lens), rng)


@named("a lens refocused after the intrinsic recording (1 %)")
def _refocused_before(scene: TrueScene, rng: Rng) -> Session:
    camera = second_camera(scene)
    now = replace(scene, rig=with_lens(scene.rig, camera, _zoomed(scene.rig.cameras[camera].intrinsics, 1.01)))
    return replace(film(now, rng), close=film_close(scene, rng))


@named("a lens beyond the model (rational, of an Azure Kinect)")
def _rational(scene: TrueScene, rng: Rng) -> Session:
    camera = second_camera(scene)
    lens = color_lens("rational", scene.rig.cameras[camera].intrinsics, rng)
    return film(replace(scene, rig=with_lens(scene.rig, camera, lens)), rng)


@named("intrinsics file of another camera")
def _other_lens(scene: TrueScene, rng: Rng) -> Session:
    lenses = {c: own.intrinsics for c, own in scene.rig.cameras.items()}
    a, b = list(lenses)[:2]
    lenses[b] = replace(lenses[a], fx=lenses[a].fx * 1.02, fy=lenses[a].fy * 1.02)
    return replace(film(scene, rng), close=None, lenses=lenses)


@named("intrinsics file of 1280x1024, scaled to 640x480")
def _other_size(scene: TrueScene, rng: Rng) -> Session:
    # 1280x1024 images show 32 rows more above and below; scaled by the sizes, focal length and centre go wrong in v
    lenses = {}
    for c, own in scene.rig.cameras.items():
        lens, s = own.intrinsics, 480 / 512
        lenses[c] = replace(lens, fy=lens.fy * s, cy=(lens.cy + 16) * s)
    return replace(film(scene, rng), close=None, lenses=lenses)


@named("one camera's images from another session")
def _other_session(scene: TrueScene, rng: Rng) -> Session:
    camera = second_camera(scene)
    boards = {f: draw_board(scene.rig, camera, scene.board, (1.3, 2.9), rng) for f in scene.boards}
    rival = [v for v in true_views(scene.rig, boards, scene.board, scene.noise, rng) if v.camera == camera]
    session = film(scene, rng)
    return replace(session, views=(*(v for v in session.views if v.camera != camera), *rival))

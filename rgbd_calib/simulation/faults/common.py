"""What the faults are made with, and the list of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.depth_error import GridField
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation.session import Session, TrueScene, film
from rgbd_calib.simulation.views import true_views
from rgbd_calib.types import BoardView, Rig

Rng = np.random.Generator
Fault = Callable[[TrueScene, Rng], Session]

FAULTS: dict[str, Fault] = {}
RINGS: set[str] = set()
"""Faults that are tried on cameras all around a board with two faces; the others on an arc."""


def named(name: str, ring: bool = False) -> Callable[[Fault], Fault]:
    def add(fault: Fault) -> Fault:
        FAULTS[name] = fault
        if ring:
            RINGS.add(name)
        return fault

    return add


def second_camera(scene: TrueScene) -> str:
    """The camera that is spoiled: not the reference."""
    return list(scene.rig.cameras)[1]


def moved_rig(rig: Rig, camera: str, xi: FloatArray) -> Rig:
    """The rig with a camera carried by (rad, m) in its own frame."""
    own = rig.cameras[camera]
    T = own.T_world_color @ se3.retract(np.eye(4), xi)
    return replace(rig, cameras={**rig.cameras, camera: replace(own, T_world_color=T)})


def with_lens(rig: Rig, camera: str, lens: Intrinsics) -> Rig:
    return replace(rig, cameras={**rig.cameras, camera: replace(rig.cameras[camera], intrinsics=lens)})


def with_pixels(rig: Rig, camera: str, scale: float, offset_px: FloatArray, roll: bool = False) -> Rig:
    """The rig with one camera whose colour and depth pixels q have become ``scale q + offset``.

    `scale` -1 rotates the images by 180 degrees; `roll` rotates the camera as well, so that its focal lengths stay positive.
    """
    own, sign = rig.cameras[camera], np.sign(scale)
    R = np.diag([sign, sign, 1.0, 1.0]) if roll else np.eye(4)

    def moved(lens: Intrinsics) -> Intrinsics:
        cx, cy = (float(v) for v in scale * np.array([lens.cx, lens.cy]) + offset_px)
        k = tuple(sign * v if i in (2, 3) else v for i, v in enumerate(lens.distortion))
        return replace(lens, fx=abs(scale) * lens.fx, fy=abs(scale) * lens.fy, cx=cx, cy=cy, distortion=k)

    depth, field = own.depth_camera, own.depth_field
    if depth is not None:
        depth = replace(depth, intrinsics=moved(depth.intrinsics), T_color_depth=R @ depth.T_color_depth @ R)
    if isinstance(field, GridField):
        way = slice(None, None, int(sign))
        u, v = (scale * axis + o for axis, o in zip((field.u_px, field.v_px), offset_px, strict=True))
        field = GridField(u[way], v[way], field.z_m, field.error[way, way])
    now = replace(
        own,
        intrinsics=moved(own.intrinsics),
        T_world_color=own.T_world_color @ R,
        depth_camera=depth,
        depth_field=field,
    )
    return replace(rig, cameras={**rig.cameras, camera: now})


def swapped_walls(session: Session, names: dict[str, str]) -> Session:
    """The session with the walls of camera names[c] in place of those of camera c."""
    assert session.walls is not None
    cells = session.wall_cells
    return replace(
        session,
        walls={**session.walls, **{c: session.walls[other] for c, other in names.items()}},
        wall_cells=cells and {**cells, **{c: cells[other] for c, other in names.items()}},
    )


def changed_half_way(scene: TrueScene, rig: Rig, rng: Rng) -> Session:
    """The second half of the recording by another rig, which is the one that is used afterwards."""
    names = list(scene.boards)
    first = {f: scene.boards[f] for f in names[: len(names) // 2]}
    rest = {f: scene.boards[f] for f in names[len(names) // 2 :]}
    views = [
        *true_views(scene.rig, first, scene.board, scene.noise, rng),
        *true_views(rig, rest, scene.board, scene.noise, rng),
    ]
    now = rig.cameras[rig.reference].T_world_color  # the world is the reference as it stands now
    cameras = {c: replace(own, T_world_color=se3.inverse(now) @ own.T_world_color) for c, own in rig.cameras.items()}
    boards = {f: se3.inverse(now) @ T for f, T in scene.boards.items()}
    return replace(film(scene, rng), truth=replace(rig, cameras=cameras), boards=boards, views=tuple(views))


def change_views(
    session: Session, camera: str, change: Callable[[BoardView], BoardView], close: bool = False
) -> Session:
    """A change to all views of a camera, those of the intrinsic recording too if `close`."""

    def all_of(views: tuple[BoardView, ...]) -> tuple[BoardView, ...]:
        return tuple(change(v) if v.camera == camera else v for v in views)

    near = all_of(session.close) if close and session.close is not None else session.close
    return replace(session, views=all_of(session.views), close=near)


def with_depths(view: BoardView, depth_m: FloatArray) -> BoardView:
    return replace(view, depth_m=depth_m, depth_pixels=np.where(np.isfinite(depth_m), view.depth_pixels, 0))

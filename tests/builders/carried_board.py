"""A carried board as simulated, and what the estimate takes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from synthetic_views import without_depth

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.rig.motion.estimate import StampedView
from rgbd_calib.rig.motion.setup import ClockPrior
from rgbd_calib.rig.setup import CameraPrior, MountPrior
from rgbd_calib.simulation.clocks import WaveParams
from rgbd_calib.simulation.poses import looks_at_back
from rgbd_calib.simulation.session import draw_scene
from rgbd_calib.simulation.wave import WaveSession, film_wave
from rgbd_calib.types import BoardView, Clock, DepthBias, PlacedView

DEPTH_AT = np.array([0.010, -0.008, 0.004, 0.052, -0.002, 0.001])
OFF_S = 0.004
"""What the correlation of motions leaves of an offset."""


def carried(session: WaveSession, rng: np.random.Generator, every: int = 1) -> dict[str, object]:
    """What the estimate takes, a little off the truth."""
    views = []
    for view in session.views[::every]:
        T = se3.inverse(session.truth.cameras[view.camera].T_world_color) @ session.T_world_board(view)
        back = bool(looks_at_back(T, session.board))
        color_us, depth_us = session.stamps_us[view.camera][view.frame]
        placed = PlacedView(view, back, False, se3.retract(T, rng.normal(0, 0.002, 6)))
        views.append(StampedView(placed, 1e-6 * color_us, 1e-6 * depth_us))
    cameras = session.truth.cameras
    poses = {c: se3.retract(own.T_world_color, rng.normal(0, 0.003, 6)) for c, own in cameras.items()}
    poses["C1"] = np.eye(4)
    clocks = {
        c: ClockPrior(Clock(own.offset_s + OFF_S * (c != "C1")), readout_sd_s=0.015 if own.readout_s else 0.0)
        for c, own in session.clocks.items()
    }
    return {
        "carried": views,
        "standing": [],
        "board": session.board,
        "priors": {c: CameraPrior(own.intrinsics, None, True, None) for c, own in cameras.items()},
        "clocks": clocks,
        "first_s": {c: 1e-6 * min(s for s, _ in own.values()) for c, own in session.stamps_us.items()},
        "T_world_color": poses,
        "reference": "C1",
    }


def with_depth_cameras(given: dict[str, object], session: WaveSession, rng: np.random.Generator) -> dict[str, object]:
    """The same with depth that is not registered: read at a depth camera's own instant where the stated geometry has the corners."""
    out, board = dict(given), session.board
    views = [replace(v, placed=replace(v.placed, view=without_depth(v.placed.view))) for v in given["carried"]]
    lens, T_true = Intrinsics(512, 424, 366.0, 367.0, 255.0, 209.0), se3.retract(np.eye(4), DEPTH_AT)
    T_stated = T_true @ se3.retract(np.eye(4), np.array([0.004, 0.003, -0.002, 0.003, -0.002, 0.001]))
    for own in list(views):
        view, name = own.placed.view, f"{own.placed.view.camera}/depth"
        T = se3.inverse(T_stated) @ own.placed.T_color_board
        pixels = lens.project(se3.transform(T, own.placed.points_m(board)))
        color, clock = session.truth.cameras[view.camera], session.clocks[view.camera]
        at_s = session.t_s[view.camera][view.frame] + clock.depth_delay_s
        plane = se3.inverse(color.T_world_color @ T_true) @ session.motion.poses(np.array([at_s]))[0]
        plane = plane @ board.T_face_board(own.placed.back, False)
        z = (plane[:3, 3] @ plane[:3, 2]) / (lens.rays(pixels) @ plane[:3, 2])
        z = z + rng.normal(0, 0.7e-3, len(z)) * z**2
        seen = BoardView(name, view.frame, view.ids, pixels, z, np.full(len(z), 20), True)
        views.append(StampedView(replace(own.placed, view=seen, T_color_board=T), own.color_s, own.color_s))
    out["carried"] = views
    for key in ("priors", "clocks", "first_s", "T_world_color"):
        out[key] = dict(given[key])
    for c in session.truth.cameras:
        mount = MountPrior(c, np.repeat([0.03, 0.010], 3))
        bias = DepthBias((0.0,), 0.5, 4.0, 0.0, np.array([[1e-10]]))
        out["priors"][f"{c}/depth"] = CameraPrior(lens, None, False, bias, same_sensor=True, mount=mount)
        out["clocks"][f"{c}/depth"] = replace(given["clocks"][c], beside=c)
        out["first_s"][f"{c}/depth"] = given["first_s"][c]
        out["T_world_color"][f"{c}/depth"] = given["T_world_color"][c] @ T_stated
    return out


def filmed(seed: int, n: int = 2, **wave: float) -> tuple[WaveSession, np.random.Generator]:
    rng = np.random.default_rng(seed)
    scene = draw_scene(n, "arc", 0, 0, rng)
    return film_wave(scene, WaveParams(**{"seconds": 6.0, "offset_s": 0.5, **wave}), rng), rng

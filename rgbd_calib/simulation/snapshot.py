"""Snapshots of the empty scene of a simulated rig, before and after something changed, with the truth.

The rig is that of :func:`.recording.simulate` for the same parameters and seed, so that a rig calibrated by that
simulation can be checked by these snapshots.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io import recording as files
from rgbd_calib.io.rig import write_rig
from rgbd_calib.quality import Quality, TrueChange
from rgbd_calib.simulation.changes import SceneChange, scenes
from rgbd_calib.simulation.color_sensor import Optics, develop
from rgbd_calib.simulation.depth_sensor import DepthNoise
from rgbd_calib.simulation.infrared import room_reflectance
from rgbd_calib.simulation.lighting import instant_light
from rgbd_calib.simulation.params import SNAPSHOT, SimulationParams, generator
from rgbd_calib.simulation.reading import reading
from rgbd_calib.simulation.recording import Progress, camera_infos, provenance, true_rig_of, workers
from rgbd_calib.simulation.render import IdealImage, render_room
from rgbd_calib.simulation.rig import TrueRig
from rgbd_calib.simulation.scene import Caster, Scene
from rgbd_calib.simulation.surfaces import see_room
from rgbd_calib.simulation.view import View
from rgbd_calib.types import Rig

State = Literal["old", "new"]
STATES: tuple[State, State] = ("old", "new")
CHANGED_M = 0.01
"""A pixel whose depth changes by more, seen from where the camera stood, is a changed part of the scene."""


@dataclass(frozen=True)
class IdealSnapshot:
    """What a camera sees, without any noise: its colour image and its depth image's geometry."""

    picture: IdealImage
    z_m: FloatArray
    """(h, w) of the depth image, along its axis."""
    cos_incidence: FloatArray
    """(h, w)."""
    reflectance: FloatArray | None
    """(h, w); None where no sensor needs it."""
    rays: FloatArray
    """(h, w) length of the depth camera's rays with z = 1."""


@dataclass(frozen=True)
class Taken:
    """One camera's part of a snapshot."""

    color: np.ndarray
    """(h, w, 3), uint8, B G R."""
    depth_raw: np.ndarray
    """(frames, h, w), uint16, millimetres, 0 where there is none."""


def look(
    truth: TrueRig,
    params: SimulationParams,
    camera: str,
    T_room_color: FloatArray,
    caster: Caster,
    rng: np.random.Generator,
) -> IdealSnapshot:
    """What a camera of the rig sees from `T_room_color` (4, 4).

    The rays' noise must not be the same from two places: it would look like a scene that moves with the camera.
    """
    view = View(truth.intrinsics[camera], T_room_color)
    picture = render_room(view, caster, rng)
    own = truth.depth_camera.get(camera)
    seen_from = view if own is None else View(own.intrinsics, T_room_color @ own.T_color_depth)
    z_m, cos = (picture.z_m, picture.cos_incidence) if own is None else see_room(seen_from, caster)
    paint = None if isinstance(params.depth_noise, DepthNoise) else room_reflectance(seen_from, caster)
    rays = np.linalg.norm(seen_from.in_camera, axis=1).reshape(seen_from.shape)
    return IdealSnapshot(picture, z_m, cos, paint, rays)


def take(
    sight: IdealSnapshot,
    truth: TrueRig,
    params: SimulationParams,
    camera: str,
    frames: int,
    rng: np.random.Generator,
    change: SceneChange | None = None,
) -> Taken:
    """What the sensors make of it; `change` is that of the new snapshot (its light and the warm-up of depth count)."""
    change = change or SceneChange()
    realism, optics, lit = params.realism, None, np.full(sight.picture.z_m.shape, change.light)
    if realism.has("images"):
        optics = Optics(truth.focus_m[camera], realism.defocus_px_m, realism.exposure_error)
        lit *= instant_light(realism.light_change, 0.0, rng).level
    color = develop(sight.picture, params.color_noise, rng, optics, lit)
    warm_m = sight.z_m * (1 + change.depth_scale) + change.depth_offset_m
    seen = warm_m, sight.cos_incidence, sight.reflectance, sight.rays
    depths = [reading(params, truth, camera, *seen, rng) for _ in range(frames)]
    return Taken(color, np.stack(depths))


@dataclass(frozen=True)
class _Setting:
    params: SimulationParams
    truth: TrueRig
    change: SceneChange
    frames: int
    scenes: dict[State, Scene]
    folder: Path


_setting: _Setting


def _start(setting: _Setting) -> None:
    global _setting  # one for each process
    _setting = setting
    cv2.setNumThreads(1)


def _make(job: tuple[State, str]) -> tuple[State, str, float]:
    """Take and save one camera's part; returns the share of its image that changed."""
    state, camera = job
    params, truth, change = _setting.params, _setting.truth, _setting.change
    T_room_color, caster = truth.T_room_color[camera], Caster(_setting.scenes[state])
    moved = T_room_color @ change.T_old_new(camera) if state == "new" else T_room_color
    rng = generator(params.seed, SNAPSHOT, truth.cameras.index(camera), STATES.index(state))
    sight = look(truth, params, camera, moved, caster, rng)
    taken = take(sight, truth, params, camera, _setting.frames, rng, change if state == "new" else None)
    for k, depth in enumerate(taken.depth_raw):
        # the scene is still: one colour image does
        if k == 0:
            files.save_color(_setting.folder / state, camera, f"{k:06d}", taken.color)
        files.save_depth(_setting.folder / state, camera, f"{k:06d}", depth)
    return state, camera, changed_share(truth, camera, _setting.scenes) if state == "new" else 0.0


def changed_share(truth: TrueRig, camera: str, both: dict[State, Scene]) -> float:
    """Share of the image, seen from where the camera stood at first, whose depth changed."""
    view = View(truth.intrinsics[camera], truth.T_room_color[camera])
    z_m = [see_room(view, Caster(both[state]))[0] for state in STATES]
    return float(np.mean(np.abs(z_m[1] - z_m[0]) > CHANGED_M))


@one_blas_thread
def simulate_snapshots(
    folder: Path, params: SimulationParams, change: SceneChange, frames: int, jobs: int, progress: Progress
) -> dict[str, float]:
    """Write old/, new/ and truth.yaml into an existing empty folder; `frames` depth images and one colour image a camera.

    Returns
    -------
    The share of each camera's image that changed.
    """
    truth = true_rig_of(params)
    both = dict(zip(STATES, scenes(change, generator(params.seed, SNAPSHOT)), strict=True))
    setting = _Setting(params, truth, change, frames, both, folder)
    work = [(state, camera) for state in STATES for camera in truth.cameras]
    changed: dict[str, float] = {}
    with workers(_start, setting, jobs) as run:
        for state, camera, share in progress(run(_make, work), len(work), "snapshots"):
            if state == "new":
                changed[camera] = share
    for name in STATES:
        files.write_dataset(folder / name, camera_infos(params, truth), None)
    write_rig(folder / "truth.yaml", _truth(truth, params, change, changed))
    return {c: changed[c] for c in truth.cameras}


def _truth(truth: TrueRig, params: SimulationParams, change: SceneChange, changed: dict[str, float]) -> Rig:
    """The rig of the old snapshot, and in `quality.snapshot` what changed."""
    snapshot = TrueChange(
        T_old_new={c: change.T_old_new(c) for c in truth.cameras},
        moved=tuple(c for c in truth.cameras if c in change.twists),
        changed_share={c: changed[c] for c in truth.cameras},
        light=change.light,
        depth_scale=change.depth_scale,
        depth_offset_m=change.depth_offset_m,
    )
    return Rig(truth.cameras[0], truth.rig_cameras, Quality(snapshot=snapshot), dict(provenance(params)))

"""Makes the images of a simulation, one colour and depth pair per job, in any number of processes.

Each pair has its own random generator, seeded by seed, camera and frame, so that the bytes do not depend on the number of
processes or their order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io import recording as files
from rgbd_calib.io.files import whole_file
from rgbd_calib.io.images import write_image
from rgbd_calib.sensors.depth_average import mean_depth
from rgbd_calib.simulation import board as boards
from rgbd_calib.simulation import poses
from rgbd_calib.simulation.bent import bent_faces
from rgbd_calib.simulation.carried import depth_picture, render_carried
from rgbd_calib.simulation.color_sensor import Optics, develop
from rgbd_calib.simulation.depth_sensor import DepthNoise
from rgbd_calib.simulation.infrared import infrared_image, reflectance, room_reflectance, with_board_reflectance
from rgbd_calib.simulation.lighting import instant_light
from rgbd_calib.simulation.params import IMAGE, LIGHT, ROOM, SimulationParams, generator
from rgbd_calib.simulation.plan import Job
from rgbd_calib.simulation.printed import Printed
from rgbd_calib.simulation.reading import reading
from rgbd_calib.simulation.render import IdealImage, render_room, render_with_board
from rgbd_calib.simulation.rig import TrueRig
from rgbd_calib.simulation.room import furnished_room
from rgbd_calib.simulation.scene import Caster
from rgbd_calib.simulation.surfaces import see_board, see_room, with_board
from rgbd_calib.simulation.time_of_flight import amplitude
from rgbd_calib.simulation.view import View
from rgbd_calib.simulation.wall import WALL_COLOR, render_wall


@dataclass(frozen=True)
class Setting:
    """The state shared by all processes."""

    params: SimulationParams
    rig: TrueRig
    board: Printed | None
    """None: an ideal board."""
    folder: Path
    rooms: Path
    """Folder of the rendered images of the empty room."""


_LIGHT_STEP = 4
_FAR_M = 20.0
"""Depth assumed for the light where nothing is hit."""

_setting: Setting


def start(setting: Setting) -> None:
    global _setting  # one for each process
    _setting = setting
    for cache in (_view, _room_picture, _depth_view, _room_depth, _room_reflectance, _length):
        cache.cache_clear()
    cv2.setNumThreads(1)


@lru_cache(maxsize=1)
def _room() -> Caster:
    return Caster(furnished_room())


@lru_cache(maxsize=64)
def _view(camera: str) -> View:
    return View(_setting.rig.intrinsics[camera], _setting.rig.T_room_color[camera])


def make_room(camera: str) -> str:
    index = _setting.rig.cameras.index(camera)
    picture = render_room(_view(camera), _room(), generator(_setting.params.seed, ROOM, index))
    np.savez(_setting.rooms / f"{camera}.npz", light=picture.light, z=picture.z_m, cos=picture.cos_incidence)
    return camera


@lru_cache(maxsize=64)
def _room_picture(camera: str) -> IdealImage:
    with np.load(_setting.rooms / f"{camera}.npz") as stored:
        return IdealImage(stored["light"], stored["z"], stored["cos"])


@lru_cache(maxsize=64)
def _depth_view(camera: str) -> View | None:
    """None: the depth image has the colour camera's geometry."""
    own = _setting.rig.depth_camera.get(camera)
    return None if own is None else View(own.intrinsics, _setting.rig.T_room_color[camera] @ own.T_color_depth)


@lru_cache(maxsize=64)
def _room_depth(camera: str) -> tuple[FloatArray, FloatArray]:
    """Depth and cosine of incidence, (h, w) each, of the empty room as the depth camera sees it."""
    view = _depth_view(camera)
    if view is None:
        picture = _room_picture(camera)
        return picture.z_m, picture.cos_incidence
    return see_room(view, _room())


@lru_cache(maxsize=64)
def _room_reflectance(camera: str) -> FloatArray:
    return room_reflectance(_depth_view(camera) or _view(camera), _room())


@dataclass(frozen=True)
class _Sight:
    """What a depth camera sees."""

    z_m: FloatArray
    """(h, w)."""
    cos_incidence: FloatArray
    """(h, w)."""
    reflectance: FloatArray | None
    """(h, w); None if not needed."""


def make_images(job: Job) -> tuple[tuple[str, str, str], list[tuple[Any, ...]]]:
    """Make and save one pair of images; returns its key and its rows of true_corners.csv."""
    params = _setting.params
    rng = generator(params.seed, IMAGE, _setting.rig.cameras.index(job.camera), int(job.frame))
    view = _view(job.camera)
    rows: list[tuple[Any, ...]] = []
    board_caster = None
    if job.T_room_board is None:
        assert job.wall is not None
        picture = render_wall(view, job.wall.wall, rng)
    elif job.carried is not None:
        room, K = _room_picture(job.camera), _setting.rig.intrinsics[job.camera]
        args = (K, _setting.rig.T_room_color[job.camera], room, _room(), params.board, _setting.board)
        picture = render_carried(job.carried, *args, rng)
        board_caster = Caster(boards.plate(params.board).moved(job.T_room_board))
        rows = _true_corners(job, view, board_caster)
    else:
        board_caster = Caster(boards.on_stand(params.board, job.T_room_board, _ground(job.T_room_board)))
        bent = bent_faces(_setting.board, job.T_room_board, view.origin_m)
        picture = render_with_board(view, _room_picture(job.camera), _room(), board_caster, rng, bent)
        rows = _true_corners(job, view, board_caster)
    folder = _setting.folder / job.recording
    _save_color(folder, job, develop(picture, params.color_noise, rng, *_taking(job, view, picture.z_m)))
    if job.carried is not None:
        picture, board_caster = depth_picture(
            job.carried, view, _room_picture(job.camera), params.board, _setting.board
        )
        job = replace(job, T_room_board=job.carried.depth_pose)
    _make_depth(folder, job, _sight(job, picture, board_caster, rng), rng)
    return (job.recording, job.camera, job.frame), rows


def _make_depth(folder: Path, job: Job, sight: _Sight, rng: np.random.Generator) -> None:
    """Measure and save the depth image and, if wanted, the infrared image."""
    params, truth = _setting.params, _setting.rig
    seen = sight.z_m, sight.cos_incidence, sight.reflectance, _length(job.camera)
    drift_m = truth.drift_m(job.camera, job.warm)
    readings = [reading(params, truth, job.camera, *seen, rng, drift_m) for _ in range(params.depth_readings)]
    files.save_depth(folder, job.camera, job.frame, mean_depth(readings))
    if params.infrared:
        assert sight.reflectance is not None
        brightness = amplitude(sight.z_m, sight.cos_incidence, sight.reflectance, _length(job.camera))
        image = infrared_image(brightness, np.uint8 if isinstance(params.depth_noise, DepthNoise) else np.uint16, rng)
        write_image(folder / job.camera / "ir" / f"{job.frame}.png", image)


@lru_cache(maxsize=64)
def _length(camera: str) -> FloatArray:
    """Length (h, w) of the depth camera's rays with z = 1."""
    view = _depth_view(camera) or _view(camera)
    return np.linalg.norm(view.in_camera, axis=1).reshape(view.shape)


def _sight(job: Job, picture: IdealImage, board_caster: Caster | None, rng: np.random.Generator) -> _Sight:
    """What the depth camera sees, in its own geometry."""
    own = _depth_view(job.camera)
    view = own or _view(job.camera)
    asked = _setting.params.infrared or not isinstance(_setting.params.depth_noise, DepthNoise)
    if board_caster is None:
        assert job.wall is not None
        paint = np.full(view.shape, reflectance(WALL_COLOR)) if asked else None
        if own is None:
            return _Sight(picture.z_m, picture.cos_incidence, paint)
        wall = job.wall.wall.moved(se3.inverse(_setting.rig.depth_camera[job.camera].T_color_depth))
        return _Sight(wall.z_m(view), wall.cos_incidence(view), paint)
    if own is None and not asked:
        return _Sight(picture.z_m, picture.cos_incidence, None)
    assert job.T_room_board is not None
    room_z_m, room_cos = _room_depth(job.camera)
    bent = bent_faces(_setting.board, job.T_room_board, view.origin_m)
    seen = see_board(view, room_z_m, board_caster, bent)
    lit = _room_reflectance(job.camera) if asked else None
    back = None if lit is None else with_board_reflectance(view, lit, board_caster, seen, bent, rng)
    return _Sight(*with_board(room_z_m, room_cos, seen), back)


def _taking(job: Job, view: View, z_m: FloatArray) -> tuple[Optics | None, FloatArray | None]:
    """Focus and exposure of the camera, and the illumination factor (h, w) of this frame."""
    realism = _setting.params.realism
    if not realism.has("images"):
        return None, None
    optics = Optics(_setting.rig.focus_m[job.camera], realism.defocus_px_m, realism.exposure_error)
    at_instant = generator(_setting.params.seed, LIGHT, int(job.frame))
    light = instant_light(realism.light_change, realism.light_slope, at_instant)
    # smooth over metres: every fourth pixel is enough
    few = np.minimum(z_m[::_LIGHT_STEP, ::_LIGHT_STEP], _FAR_M)
    rays = view.centres.reshape(*z_m.shape, 3)[::_LIGHT_STEP, ::_LIGHT_STEP]
    lit = light.at(view.origin_m + few[..., None] * rays)
    return optics, np.asarray(cv2.resize(lit, z_m.shape[::-1], interpolation=cv2.INTER_LINEAR), float)


def _save_color(folder: Path, job: Job, image: np.ndarray) -> None:
    quality = _setting.params.jpeg_quality
    if quality is None:
        files.save_color(folder, job.camera, job.frame, image)
        return
    with whole_file(folder / job.camera / "color" / f"{job.frame}.jpg", durable=False) as path:
        path.write_bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes())


def _ground(T_room_board: FloatArray) -> float:
    """Height of the floor, or of the furniture, under the board's stand, metres."""
    top = boards.stand_foot_m(_setting.params.board, T_room_board)
    below = _room().cast(top, np.array([[0.0, 0.0, -1.0]])).t[0]
    return float(top[2] - below)


def _true_corners(job: Job, view: View, board_caster: Caster) -> list[tuple[Any, ...]]:
    """Rows of true_corners.csv: the face that this camera looks at, where any of it is in the image."""
    assert job.T_room_board is not None
    board, K = _setting.params.board, view.intrinsics
    T_color_board = se3.inverse(_setting.rig.T_room_color[job.camera]) @ job.T_room_board
    back = bool(poses.looks_at_back(T_color_board, board))
    shaped = board if _setting.board is None else _setting.board.board
    p = se3.transform(T_color_board, shaped.corners_m(back))
    if job.carried is not None:
        p = job.carried.points(K, _setting.rig.T_room_color[job.camera], shaped.corners_m(back))
    if (back and not board.two_sided) or np.any(p[:, 2] < 0.1):
        return []
    px = K.project(p)
    inside = np.all((px > -0.5) & (px < np.array([K.width, K.height]) - 0.5), axis=1)
    # far outside the image a lens model may fold back
    border = K.rays(np.array([[0, 0], [K.width - 1, 0], [0, K.height - 1], [K.width - 1, K.height - 1.0]]))
    inside &= np.linalg.norm(p[:, :2] / p[:, 2:], axis=1) < 1.2 * np.linalg.norm(border[:, :2], axis=1).max()
    if not inside.any():
        return []
    toward = se3.transform(job.T_room_board, board.corners_m(back)) - view.origin_m
    eyes = np.broadcast_to(view.origin_m, toward.shape)
    far = 1 - 0.002 / np.linalg.norm(p, axis=1).max()
    # occlusion is tested with the flat nominal board of the ray caster
    hidden = _room().blocked(eyes, toward, far) | board_caster.blocked(eyes, toward, far)
    face = "back" if back else "front"
    return [
        (job.recording, job.camera, job.frame, face, k, *(f"{x:.5f}" for x in px[k]), *(f"{x:.7f}" for x in p[k]),
         int(inside[k] and not hidden[k]))
        for k in range(board.n_corners)
    ]  # fmt: skip

"""Whole simulated recordings on disk, with their truth.

Every image has its own random generator, made of the seed, its kind, camera and frame, so that the bytes do not depend
on the number of processes or on their order.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io import recording as files
from rgbd_calib.io.files import whole_file
from rgbd_calib.simulation import board as boards
from rgbd_calib.simulation import poses, rig
from rgbd_calib.simulation.bent import bent_faces
from rgbd_calib.simulation.color_sensor import ColorNoise, Optics, develop
from rgbd_calib.simulation.depth_sensor import DepthNoise, measure
from rgbd_calib.simulation.lighting import instant_light
from rgbd_calib.simulation.printed import Printed, printed
from rgbd_calib.simulation.realism import IDEAL, Realism
from rgbd_calib.simulation.render import Picture, render_room, render_with_board
from rgbd_calib.simulation.rig import Layout, TrueRig
from rgbd_calib.simulation.room import furnished_room
from rgbd_calib.simulation.scene import Caster
from rgbd_calib.simulation.surfaces import see_board, see_room, with_board
from rgbd_calib.simulation.truth import write_truth
from rgbd_calib.simulation.view import View
from rgbd_calib.simulation.wall import SQUARE, TapedWall, Wall, render_wall, tilted
from rgbd_calib.types import Board

Progress = Callable[[Iterable[Any], int, str], Iterator[Any]]

_RIG, _SHARED, _CLOSE, _ROOM, _IMAGE, _WALL, _PRINT, _SENSORS, _TAPE, _LIGHT = range(10)
"""First word of each random generator's key."""

CORNER_COLUMNS = (
    "recording", "camera", "frame", "face", "feature", "u_px", "v_px", "x_m", "y_m", "z_m", "visible",
)  # fmt: skip


@dataclass(frozen=True)
class SimulationParams:
    """What to simulate. `frames` None means 30, or 8 for each camera where that is more."""

    cameras: int = 4
    layout: Layout = "arc"
    frames: int | None = None
    intrinsic_views: int = 20
    distances_m: tuple[float, ...] = (0.6, 0.9, 1.2, 1.5, 1.8, 2.2, 2.6, 3.0, 3.5, 4.0)
    width: int = 640
    height: int = 480
    seed: int = 0
    board: Board = field(default=Board(9, 6, 0.060, two_sided=True, thickness_m=0.006))
    color_noise: ColorNoise = field(default=ColorNoise())
    depth_noise: DepthNoise = field(default=DepthNoise())
    bias: bool = True
    """False: the depth sensors have no bias."""
    jpeg_quality: int | None = None
    """None: colour images are PNG."""
    realism: Realism = IDEAL
    """What is wrong besides lenses, bias and noise."""


@dataclass(frozen=True)
class _Job:
    """One pair of images to make: of the board at `T_room_board`, or of a wall."""

    recording: str
    camera: str
    frame: str
    T_room_board: FloatArray | None = None
    wall: TapedWall | None = None


@dataclass(frozen=True)
class _Setting:
    """What every process knows."""

    params: SimulationParams
    rig: TrueRig
    board: Printed | None
    """None: as it should be."""
    folder: Path
    rooms: Path
    """Folder of the finished pictures of the empty room."""


def generator(seed: int, *key: int) -> np.random.Generator:
    """The random generator of one piece of work."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


def simulate(folder: Path, params: SimulationParams, jobs: int, progress: Progress) -> dict[str, int]:
    """Write extrinsic/, intrinsic/, depth_bias/, truth.yaml and true_corners.csv into an existing empty folder.

    Returns the number of frames by recording.

    Raises
    ------
    CalibrationError
        The board cannot be seen by the cameras.
    """
    truth = true_rig_of(params)
    made = (
        printed(params.board, params.realism, generator(params.seed, _PRINT)) if params.realism.has("print") else None
    )
    shared, close, work = _plan(truth, params)
    with tempfile.TemporaryDirectory(prefix="rgbd-calib-") as rooms:
        setting = _Setting(params, truth, made, folder, Path(rooms))
        corners: dict[tuple[str, str, str], list[tuple[Any, ...]]] = {}
        with _workers(setting, jobs) as run:
            for _ in progress(run(_make_room, truth.cameras), len(truth.cameras), "empty room"):
                pass
            for key, rows in progress(run(_make_images, work), len(work), "images"):
                corners[key] = rows
    ordered = [row for key in sorted(corners) for row in corners[key]]
    files.write_table(folder / "true_corners.csv", CORNER_COLUMNS, ordered)
    _write_datasets(folder, params, truth, work)
    walls = {c: {j.frame: j.wall for j in work if j.wall is not None and j.camera == c} for c in truth.cameras}
    write_truth(folder / "truth.yaml", truth, made, walls, shared | close, _provenance(params))
    return {
        name: len({j.frame for j in work if j.recording == name}) for name in ("extrinsic", "intrinsic", "depth_bias")
    }


@contextmanager
def _workers(setting: _Setting, jobs: int) -> Iterator[Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]]:
    """A `map` in any order: over processes of one thread each, or, with one job, in this process."""
    if jobs == 1:
        _start(setting)
        yield map
        return
    threads = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in threads}
    os.environ.update(dict.fromkeys(threads, "1"))
    try:
        pool = get_context("spawn").Pool(jobs, _start, (setting,))
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value
    with pool:
        yield pool.imap_unordered


def true_rig_of(params: SimulationParams) -> TrueRig:
    """The rig that a simulation with these parameters has."""
    rng = generator(params.seed, _RIG)
    truth = rig.true_rig(params.cameras, params.layout, params.width, params.height, rng)
    if not params.bias:
        truth = replace(truth, depth_bias={c: rig.no_depth_bias() for c in truth.cameras})
    return rig.with_errors(truth, params.realism, generator(params.seed, _SENSORS))


def _plan(truth: TrueRig, params: SimulationParams) -> tuple[dict[str, FloatArray], dict[str, FloatArray], list[_Job]]:
    """Board poses of the shared and of the close frames, T_room_board (4, 4) by frame, and all images to make.

    Frames of the shared recording count from 000000, close views from 101000 for C1, 102000 for C2, ..., walls from
    201000: no instant is in two recordings.
    """
    room, common_m = Caster(furnished_room()), _tape_error_m(params)
    n_frames = params.frames if params.frames is not None else max(30, 8 * params.cameras)
    found = poses.shared_poses(truth, params.board, n_frames, room, generator(params.seed, _SHARED))
    shared = {f"{i:06d}": T for i, T in enumerate(found)}
    work = [_Job("extrinsic", c, f, T) for f, T in shared.items() for c in truth.cameras]
    close: dict[str, FloatArray] = {}
    for i, c in enumerate(truth.cameras):
        views = poses.close_poses(
            truth, params.board, c, params.intrinsic_views, room, generator(params.seed, _CLOSE, i)
        )
        mine = {f"{101000 + 1000 * i + k:06d}": T for k, T in enumerate(views)}
        close |= mine
        work += [_Job("intrinsic", c, f, T) for f, T in mine.items()]
        for k, d in enumerate(params.distances_m):
            taped = _wall(d, params.realism, common_m, generator(params.seed, _WALL, i, k))
            work.append(_Job("depth_bias", c, f"{201000 + 1000 * i + k:06d}", wall=taped))
    return shared, close, work


def _tape_error_m(params: SimulationParams) -> float:
    """What all walls' distances are too long by as written: one tape, one zero."""
    return float(generator(params.seed, _TAPE).normal(0, params.realism.tape_common_m))


def _wall(about_m: float, realism: Realism, common_m: float, rng: np.random.Generator) -> TapedWall:
    # nobody puts a wall to the millimetre: the distance is measured, not set
    exact_m = round(about_m + rng.uniform(-0.03, 0.03), 4)
    if not realism.has("walls"):
        return TapedWall(Wall(exact_m, SQUARE), exact_m)
    wall = Wall(exact_m, tilted(realism.wall_tilt_rad, rng))
    return TapedWall(wall, round(exact_m + common_m + rng.normal(0, realism.tape_m), 3), realism.tape_m)


_setting: _Setting


def _start(setting: _Setting) -> None:
    global _setting  # one for each process
    _setting = setting
    for cache in (_view, _room_picture, _depth_view, _room_depth):
        cache.cache_clear()
    cv2.setNumThreads(1)


@lru_cache(maxsize=1)
def _room() -> Caster:
    return Caster(furnished_room())


@lru_cache(maxsize=64)
def _view(camera: str) -> View:
    return View(_setting.rig.intrinsics[camera], _setting.rig.T_room_color[camera])


def _make_room(camera: str) -> str:
    index = _setting.rig.cameras.index(camera)
    picture = render_room(_view(camera), _room(), generator(_setting.params.seed, _ROOM, index))
    np.savez(_setting.rooms / f"{camera}.npz", light=picture.light, z=picture.z_m, cos=picture.cos_incidence)
    return camera


@lru_cache(maxsize=64)
def _room_picture(camera: str) -> Picture:
    with np.load(_setting.rooms / f"{camera}.npz") as stored:
        return Picture(stored["light"], stored["z"], stored["cos"])


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


def _make_images(job: _Job) -> tuple[tuple[str, str, str], list[tuple[Any, ...]]]:
    """Make, save, and give the true corners of one pair of images."""
    params, truth = _setting.params, _setting.rig
    rng = generator(params.seed, _IMAGE, truth.cameras.index(job.camera), int(job.frame))
    view, depth_view = _view(job.camera), _depth_view(job.camera)
    rows: list[tuple[Any, ...]] = []
    if job.T_room_board is None:
        assert job.wall is not None
        picture = render_wall(view, job.wall.wall, rng)
    else:
        board_caster = Caster(boards.on_stand(params.board, job.T_room_board, _ground(job.T_room_board)))
        bent = bent_faces(_setting.board, job.T_room_board, view.origin_m)
        picture = render_with_board(view, _room_picture(job.camera), _room(), board_caster, rng, bent)
        rows = _true_corners(job, view, board_caster)
    image = develop(picture, params.color_noise, rng, *_taking(job, view, picture.z_m))
    z_m, cos = (picture.z_m, picture.cos_incidence) if depth_view is None else _seen_depth(job, depth_view)
    bias, field_ = truth.depth_bias[job.camera], truth.depth_field.get(job.camera)
    depth = measure(z_m, cos, params.depth_noise, bias, rng, field_)
    folder = _setting.folder / job.recording
    _save_color(folder, job, image)
    files.save_depth(folder, job.camera, job.frame, depth)
    return (job.recording, job.camera, job.frame), rows


def _seen_depth(job: _Job, view: View) -> tuple[FloatArray, FloatArray]:
    """True depth and cosine of incidence, (h, w) each, in a depth camera's own geometry."""
    if job.T_room_board is None:
        assert job.wall is not None
        T_color_depth = _setting.rig.depth_camera[job.camera].T_color_depth
        wall = job.wall.wall.moved(se3.inverse(T_color_depth))
        return wall.z_m(view), wall.cos_incidence(view)
    board_caster = Caster(boards.on_stand(_setting.params.board, job.T_room_board, _ground(job.T_room_board)))
    z_m, cos = _room_depth(job.camera)
    bent = bent_faces(_setting.board, job.T_room_board, view.origin_m)
    return with_board(z_m, cos, see_board(view, z_m, board_caster, bent))


def _taking(job: _Job, view: View, z_m: FloatArray) -> tuple[Optics | None, FloatArray | None]:
    """The camera's focus and exposure, and how much more light (h, w) there is at this instant."""
    realism = _setting.params.realism
    if not realism.has("images"):
        return None, None
    optics = Optics(_setting.rig.focus_m[job.camera], realism.defocus_px_m, realism.exposure_error)
    at_instant = generator(_setting.params.seed, _LIGHT, int(job.frame))
    light = instant_light(realism.light_change, realism.light_slope, at_instant)
    points = view.origin_m + np.minimum(z_m, 20.0).reshape(-1, 1) * view.centres
    return optics, light.at(points).reshape(z_m.shape)


def _save_color(folder: Path, job: _Job, image: np.ndarray) -> None:
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


def _true_corners(job: _Job, view: View, board_caster: Caster) -> list[tuple[Any, ...]]:
    """Rows of true_corners.csv: the face that this camera looks at, where any of it is in the image."""
    assert job.T_room_board is not None
    board, K = _setting.params.board, view.intrinsics
    T_color_board = se3.inverse(_setting.rig.T_room_color[job.camera]) @ job.T_room_board
    back = bool(poses.looks_at_back(T_color_board, board))
    shaped = board if _setting.board is None else _setting.board.board
    p = se3.transform(T_color_board, shaped.corners_m(back))
    if (back and not board.two_sided) or np.any(p[:, 2] < 0.1):
        return []
    px = K.project(p)
    inside = np.all((px > -0.5) & (px < np.array([K.width, K.height]) - 0.5), axis=1)
    # beyond the image's diagonal the lens model folds back
    inside &= np.linalg.norm(p[:, :2] / p[:, 2:], axis=1) < 1.2 * np.hypot(K.width, K.height) / 2 / K.fx
    if not inside.any():
        return []
    toward = se3.transform(job.T_room_board, board.corners_m(back)) - view.origin_m
    eyes = np.broadcast_to(view.origin_m, toward.shape)
    far = 1 - 0.002 / np.linalg.norm(p, axis=1).max()
    # the ray caster's board is flat, as it should be
    hidden = _room().blocked(eyes, toward, far) | board_caster.blocked(eyes, toward, far)
    face = "back" if back else "front"
    return [
        (job.recording, job.camera, job.frame, face, k, *(f"{x:.5f}" for x in px[k]), *(f"{x:.7f}" for x in p[k]),
         int(inside[k] and not hidden[k]))
        for k in range(board.n_corners)
    ]  # fmt: skip


def _write_datasets(folder: Path, params: SimulationParams, truth: TrueRig, work: list[_Job]) -> None:
    infos = {c: files.CameraInfo(params.width, params.height, serial=f"simulated-{c}") for c in truth.cameras}
    for name in dict.fromkeys(j.recording for j in work):
        board = None if name == "depth_bias" else params.board
        files.write_dataset(folder / name, infos, board)
    for c in truth.cameras:
        walls = {j.frame: j.wall for j in work if j.wall is not None and j.camera == c}
        rows = [(frame, *taped.written) for frame, taped in walls.items()]
        if rows:
            columns = ("frame", "distance_m", "sd_m")[: len(rows[0])]
            files.write_table(folder / "depth_bias" / c / "distances.csv", columns, rows)


def _provenance(params: SimulationParams) -> dict[str, Any]:
    from rgbd_calib import __version__

    noise = params.depth_noise
    simulated: dict[str, Any] = {
        "layout": params.layout,
        "seed": params.seed,
        "blur_px": params.color_noise.blur_px,
        "sigma_grey": params.color_noise.sigma_grey,
        "depth_sigma": {"model": "k z^2", "k_per_m": 0.0 if noise.ideal else noise.k_per_m},
        "disparity_step_px": noise.disparity_step_px,
    }
    if params.jpeg_quality is not None:
        simulated["jpeg_quality"] = params.jpeg_quality
    if params.color_noise.fringe_px:
        simulated["fringe_px"] = params.color_noise.fringe_px
    if params.realism != IDEAL:
        simulated["realism"] = asdict(params.realism)
    return {"program": f"rgbd-calib {__version__}", "simulated": simulated}

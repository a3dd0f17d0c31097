"""The images of a simulated session: pose of the board, or wall, in each."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.simulation import poses
from rgbd_calib.simulation.carried import BoardExposure
from rgbd_calib.simulation.clocks import CameraClock, Exposures, WaveParams, draw_clocks, expose
from rgbd_calib.simulation.motion import HandMotion, hand_motion
from rgbd_calib.simulation.params import CLOSE, SHARED, TAPE, WALL, WAVE, SimulationParams, generator
from rgbd_calib.simulation.realism import Realism
from rgbd_calib.simulation.rig import TrueRig
from rgbd_calib.simulation.room import furnished_room
from rgbd_calib.simulation.scene import Caster
from rgbd_calib.simulation.wall import SQUARE, TapedWall, Wall, tilted

_RECORDINGS = ("intrinsic", "extrinsic", "wave", "depth_bias")
"""In the order of recording."""


@dataclass(frozen=True)
class Job:
    """One pair of images to make: of the board at `T_room_board`, or of a wall."""

    recording: str
    camera: str
    frame: str
    T_room_board: FloatArray | None = None
    wall: TapedWall | None = None
    warm: float = 1.0
    """Elapsed share of the session, from 0 to 1."""
    carried: BoardExposure | None = None
    """The board's motion, where it moves."""


@dataclass(frozen=True)
class Carrying:
    """A carried board before free-running cameras."""

    motion: HandMotion
    clocks: dict[str, CameraClock]
    exposures: dict[str, Exposures]


def carrying(truth: TrueRig, params: SimulationParams, wave: WaveParams) -> Carrying:
    """The motion, in the room's frame, and when the cameras expose."""
    rng = generator(params.seed, WAVE)
    motion = hand_motion([truth.T_room_color[c] for c in truth.cameras], params.board, wave.seconds, rng)
    clocks = draw_clocks(truth.cameras, wave, rng)
    return Carrying(motion, clocks, {c: expose(clocks[c], wave, rng) for c in truth.cameras})


def _wave_jobs(own: Carrying, wave: WaveParams) -> list[Job]:
    out = []
    for c, taken in own.exposures.items():
        poses = own.motion.poses(taken.t_s)
        for stem, t, T in zip(taken.stems, taken.t_s, poses, strict=True):
            carried = BoardExposure(own.motion, np.eye(4), float(t), own.clocks[c], wave.exposure_s)
            out.append(Job("wave", c, stem, T, carried=carried))
    return out


def plan(truth: TrueRig, params: SimulationParams) -> tuple[dict[str, FloatArray], dict[str, FloatArray], list[Job]]:
    """Board poses of the shared and of the close frames, T_room_board (4, 4) by frame, and all images to make.

    A carried board has no shared frames: its images are each camera's own. Frames of the shared recording count from 000000, close views from 101000 for C1, 102000 for C2, ..., walls from
    201000: no instant is in two recordings.
    """
    room, common_m = Caster(furnished_room()), _tape_error_m(params)
    n_frames = params.frames if params.frames is not None else max(30, 8 * params.cameras)
    shared: dict[str, FloatArray] = {}
    if params.wave is not None:
        work = _wave_jobs(carrying(truth, params, params.wave), params.wave)
    else:
        found = poses.shared_poses(truth, params.board, n_frames, room, generator(params.seed, SHARED))
        shared = {f"{i:06d}": T for i, T in enumerate(found)}
        work = [Job("extrinsic", c, f, T) for f, T in shared.items() for c in truth.cameras]
    close: dict[str, FloatArray] = {}
    for i, c in enumerate(truth.cameras):
        views = poses.close_poses(
            truth, params.board, c, params.intrinsic_views, room, generator(params.seed, CLOSE, i)
        )
        mine = {f"{101000 + 1000 * i + k:06d}": T for k, T in enumerate(views)}
        close |= mine
        work += [Job("intrinsic", c, f, T) for f, T in mine.items()]
        for k, d in enumerate(params.distances_m):
            taped = _wall(d, params.realism, common_m, generator(params.seed, WALL, i, k))
            work.append(Job("depth_bias", c, f"{201000 + 1000 * i + k:06d}", wall=taped))
    return shared, close, _in_time(work)


def _in_time(work: list[Job]) -> list[Job]:
    """The jobs with their elapsed share of the session; equal for all cameras of a frame."""
    instants = sorted({(_RECORDINGS.index(job.recording), job.frame) for job in work})
    share = {frame: k / len(instants) for k, (_, frame) in enumerate(instants)}
    return [replace(job, warm=share[job.frame]) for job in work]


def _tape_error_m(params: SimulationParams) -> float:
    """Error common to all written wall distances."""
    return float(generator(params.seed, TAPE).normal(0, params.realism.tape_common_m))


def _wall(about_m: float, realism: Realism, common_m: float, rng: np.random.Generator) -> TapedWall:
    # nobody puts a wall to the millimetre: the distance is measured, not set
    exact_m = round(about_m + rng.uniform(-0.03, 0.03), 4)
    if not realism.has("walls"):
        return TapedWall(Wall(exact_m, SQUARE), exact_m)
    wall = Wall(exact_m, tilted(realism.wall_tilt_rad, rng))
    return TapedWall(wall, round(exact_m + common_m + rng.normal(0, realism.tape_m), 3), realism.tape_m)

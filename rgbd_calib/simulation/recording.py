"""Whole simulated recordings on disk, with their truth."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rgbd_calib.geometry import so3
from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io import recording as files
from rgbd_calib.io.dataset import DepthGeometry, SensorKind
from rgbd_calib.io.processes import context
from rgbd_calib.simulation import rig
from rgbd_calib.simulation.images import Setting, make_images, make_room, start
from rgbd_calib.simulation.params import LENSES, PRINT, RIG, SENSORS, SimulationParams, generator
from rgbd_calib.simulation.plan import Job, carrying, plan
from rgbd_calib.simulation.printed import printed
from rgbd_calib.simulation.realism import IDEAL
from rgbd_calib.simulation.rig import TrueRig
from rgbd_calib.simulation.time_of_flight import TimeOfFlight
from rgbd_calib.simulation.truth import write_truth
from rgbd_calib.types import Clock

Progress = Callable[[Iterable[Any], int, str], Iterator[Any]]
T = TypeVar("T")

CORNER_COLUMNS = (
    "recording", "camera", "frame", "face", "feature", "u_px", "v_px", "x_m", "y_m", "z_m", "visible",
)  # fmt: skip
TIME_COLUMNS = ("camera", "frame", "t_s", "depth_t_s", "qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
"""True times, and T_world_board at the first."""
BOARDS_EVERY_S = 0.5
"""Between the poses of a carried board in truth.yaml: as in a rig file."""


@one_blas_thread
def simulate(folder: Path, params: SimulationParams, jobs: int, progress: Progress) -> dict[str, int]:
    """Write extrinsic/ (or wave/ and true_times.csv), intrinsic/, depth_bias/, truth.yaml and true_corners.csv into an existing
    empty folder.

    Returns the number of frames by recording.

    Raises
    ------
    CalibrationError
        The board cannot be seen by the cameras.
    """
    truth = true_rig_of(params)
    made = printed(params.board, params.realism, generator(params.seed, PRINT)) if params.realism.has("print") else None
    shared, close, work = plan(truth, params)
    with tempfile.TemporaryDirectory(prefix="rgbd-calib-") as rooms:
        setting = Setting(params, truth, made, folder, Path(rooms))
        corners: dict[tuple[str, str, str], list[tuple[Any, ...]]] = {}
        with workers(start, setting, jobs) as run:
            for _ in progress(run(make_room, truth.cameras), len(truth.cameras), "empty room"):
                pass
            for key, rows in progress(run(make_images, work), len(work), "images"):
                corners[key] = rows
    ordered = [row for key in sorted(corners) for row in corners[key]]
    files.write_table(folder / "true_corners.csv", CORNER_COLUMNS, ordered)
    _write_datasets(folder, params, truth, work)
    walls = {c: {j.frame: j.wall for j in work if j.wall is not None and j.camera == c} for c in truth.cameras}
    warm = {j.frame: j.warm for j in sorted(work, key=lambda j: j.frame)}
    clocks = _write_times(folder, params, truth, work) if params.wave is not None else {}
    boards = shared | close | _carried_boards(work, corners)
    write_truth(folder / "truth.yaml", truth, made, walls, warm, boards, provenance(params), clocks)
    return {
        name: len({j.frame for j in work if j.recording == name}) for name in dict.fromkeys(j.recording for j in work)
    }


@contextmanager
def workers(
    start: Callable[[T], None], setting: T, jobs: int
) -> Iterator[Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]]:
    """A `map` in any order: over processes of one thread each, or, with one job, in this process; each calls
    ``start(setting)`` first."""
    if jobs == 1:
        start(setting)
        yield map
        return
    threads = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in threads}
    os.environ.update(dict.fromkeys(threads, "1"))
    try:
        pool = context("spawn").Pool(jobs, start, (setting,))
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value
    with pool:
        yield pool.imap_unordered


KINDS: Mapping[str, SensorKind] = {"tof": "time_of_flight", "stereo": "stereo"}
"""What dataset.yaml says of sensors; structured light is what is taken where nothing is said."""


def true_rig_of(params: SimulationParams) -> TrueRig:
    """The rig that a simulation with these parameters has."""
    rng = generator(params.seed, RIG)
    truth = rig.true_rig(params.cameras, params.layout, params.width, params.height, rng)
    truth = rig.with_lenses(truth, params.lenses, generator(params.seed, LENSES))
    if not params.bias:
        truth = replace(truth, depth_bias={c: rig.no_depth_bias() for c in truth.cameras})
    return rig.with_errors(truth, params.sensor, params.depth_size, params.realism, generator(params.seed, SENSORS))


def _write_datasets(folder: Path, params: SimulationParams, truth: TrueRig, work: list[Job]) -> None:
    infos = camera_infos(params, truth)
    for name in dict.fromkeys(j.recording for j in work):
        board = None if name == "depth_bias" else params.board
        files.write_dataset(folder / name, infos, board, synchronous=name != "wave")
    for c in truth.cameras:
        walls = {j.frame: j.wall for j in work if j.wall is not None and j.camera == c}
        rows = [(frame, *taped.written) for frame, taped in walls.items()]
        if rows:
            columns = ("frame", "distance_m", "sd_m")[: len(rows[0])]
            files.write_table(folder / "depth_bias" / c / "distances.csv", columns, rows)


def _carried_boards(
    work: Iterable[Job], corners: Mapping[tuple[str, str, str], list[tuple[Any, ...]]]
) -> dict[str, FloatArray]:
    """T_room_board (4, 4) by `camera frame`, of a carried board that a camera saw whole, each half second: where the rig can be
    judged. All poses are in true_times.csv."""
    out: dict[str, FloatArray] = {}
    visible, last = CORNER_COLUMNS.index("visible"), -np.inf
    carried = [(job, job.carried.t_s) for job in work if job.carried is not None]
    for job, t_s in sorted(carried, key=lambda own: own[1]):
        rows = corners[job.recording, job.camera, job.frame]
        if t_s - last >= BOARDS_EVERY_S and rows and all(row[visible] for row in rows):
            assert job.T_room_board is not None
            out[f"{job.camera} {job.frame}"], last = job.T_room_board, t_s
    return out


def _write_times(folder: Path, params: SimulationParams, truth: TrueRig, work: list[Job]) -> dict[str, Clock]:
    """Stamps of the cameras, and the true times and board poses beside them; returns the clocks."""
    assert params.wave is not None
    own, rows = carrying(truth, params, params.wave), []
    for c, taken in own.exposures.items():
        stamps = zip(taken.stems, taken.stamps_us, taken.stamps_us, strict=True)
        files.write_table(folder / "wave" / c / "timestamps.csv", ("frame", "color_us", "depth_us"), stamps)
        poses = truth.T_world_room @ own.motion.poses(taken.t_s)
        for stem, t, T in zip(taken.stems, taken.t_s, poses, strict=True):
            pose = (*so3.quaternion_wxyz(T[:3, :3]), *T[:3, 3])
            times = (f"{t:.7f}", f"{t + own.clocks[c].depth_delay_s:.7f}")
            rows.append((c, stem, *times, *(f"{x:.9f}" for x in pose)))
    files.write_table(folder / "true_times.csv", TIME_COLUMNS, rows)
    return {c: clock.truth for c, clock in own.clocks.items()}


def camera_infos(params: SimulationParams, truth: TrueRig) -> dict[str, files.CameraInfo]:
    """What dataset.yaml says of the cameras."""
    infos = {}
    for c in truth.cameras:
        depth, kind = None, KINDS.get(params.sensor)
        if (own := truth.stated_depth.get(c)) is not None:
            lens = own.intrinsics
            depth = DepthGeometry(lens.width, lens.height, lens, None, own.T_color_depth)
        infos[c] = files.CameraInfo(
            params.width, params.height, serial=f"simulated-{c}", depth=depth, depth_stated=depth is not None, kind=kind
        )
    return infos


def provenance(params: SimulationParams) -> dict[str, Any]:
    from rgbd_calib import __version__

    noise = params.depth_noise
    simulated: dict[str, Any] = {
        "layout": params.layout,
        "seed": params.seed,
        "blur_px": params.color_noise.blur_px,
        "sigma_grey": params.color_noise.sigma_grey,
    }
    if isinstance(noise, TimeOfFlight):
        simulated["sensor"] = asdict(noise)
    else:
        simulated["depth_sigma"] = {"model": "k z^2", "k_per_m": 0.0 if noise.ideal else noise.k_per_m}
        simulated["disparity_step_px"] = noise.disparity_step_px
    if params.depth_readings != 1:
        simulated["depth_readings"] = params.depth_readings
    if params.jpeg_quality is not None:
        simulated["jpeg_quality"] = params.jpeg_quality
    if params.color_noise.fringe_px:
        simulated["fringe_px"] = params.color_noise.fringe_px
    if params.wave is not None:
        simulated["wave"] = asdict(params.wave)
    if params.realism != IDEAL:
        simulated["realism"] = asdict(params.realism)
    return {"program": f"rgbd-calib {__version__}", "simulated": simulated}

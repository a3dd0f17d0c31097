"""Time and peak memory as a recording grows: 8 cameras x 250, 500, 1,000 frames. Is the time linear, the memory flat?

Corners are simulated for all frames (0.1 px, and depth noise), and calibrated from a recording on disk as the command does.
Images are looked for boards in a part of the frames: the files are links to a few rendered pictures under many names.
Seconds are of the CPU, but for detection, which several processes share. Peak memory is that of the process and, for
detection, of its workers, MiB.

    python scripts/benchmark_size.py
    python scripts/benchmark_size.py --frames 1000 --max-views 60 --json
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any
from unittest import mock

import click
import numpy as np

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.correspondences import read_corners, write_corners
from rgbd_calib.io.recording import CameraInfo, Recording, open_recording, write_dataset
from rgbd_calib.io.rig import write_intrinsics
from rgbd_calib.pipeline import calibrate as pipeline
from rgbd_calib.pipeline import estimators
from rgbd_calib.pipeline.config import load_config
from rgbd_calib.pipeline.detection import Detections, detect
from rgbd_calib.pipeline.workers import Workers
from rgbd_calib.simulation.recording import SimulationParams, simulate
from rgbd_calib.simulation.rig import true_rig
from rgbd_calib.simulation.views import ViewNoise, true_views
from rgbd_calib.types import Board, Rig, RigCamera
from rgbd_calib.views.detect import DetectParams

BOARD = Board(9, 6, 0.060, two_sided=True, thickness_m=0.006)
FRESH = "CHILD"
PEAKS: dict[str, int] = {}
"""KiB by process."""


def board_poses(rig: Rig, n: int, rng: np.random.Generator) -> dict[str, FloatArray]:
    """T_world_board (4, 4) by frame: within reach of all cameras, turned to one of them, tilted by up to 40 degrees."""
    cameras = list(rig.cameras.values())
    middle = BOARD.corners_m().mean(axis=0)
    aims = np.stack([c.T_world_color[:3, 3] + 2.3 * c.T_world_color[:3, 2] for c in cameras])
    out = {}
    for k in range(n):
        T_world_color = cameras[k % len(cameras)].T_world_color
        R = T_world_color[:3, :3] @ so3.exp(rng.uniform(-0.7, 0.7, 3) * [1, 1, 0.5])
        place = aims.mean(axis=0) + T_world_color[:3, :3] @ rng.uniform([-0.8, -0.6, -1.1], [0.8, 0.6, 0.7])
        out[f"{k:06d}"] = se3.make(R, place - R @ middle)
    return out


def make(folder: Path, pictures: Path, cameras: int, frames: int, seed: int) -> None:
    """A recording of links, corners.csv and intrinsics.yaml in `folder`."""
    rng = np.random.default_rng(seed)
    true = true_rig(cameras, "arc", 640, 480, rng)
    own = {
        c: RigCamera(true.intrinsics[c], T, np.zeros((6, 6)), true.depth_bias[c]) for c, T in true.T_world_color.items()
    }
    rig = Rig(next(iter(own)), own)
    views = true_views(rig, board_poses(rig, frames, rng), BOARD, ViewNoise(), rng)
    source = open_recording(pictures)
    known = list(source.cameras)
    for i, camera in enumerate(own):
        for kind, files in (("color", source.color_files), ("depth", source.depth_files)):
            (folder / camera / kind).mkdir(parents=True)
            links = list(files[known[i % len(known)]].values())
            for k in range(frames):
                os.link(links[k % len(links)], folder / camera / kind / f"{k:06d}.png")
    write_dataset(folder, {c: CameraInfo(640, 480) for c in own}, BOARD)
    write_corners(folder / "corners.csv", views)
    write_intrinsics(folder / "intrinsics.yaml", true.intrinsics, {}, {}, {})


def peak_mib() -> float:
    """Peak memory of each process of this session until now, summed; of those that have ended, what was seen last."""
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            if os.getsid(int(pid)) == os.getsid(0):
                lines = Path(f"/proc/{pid}/status").read_text().splitlines()
                PEAKS[pid] = max(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
        except (OSError, ValueError):
            continue  # it has ended
    return sum(PEAKS.values()) / 1024


def watch() -> None:
    """Look at the memory until the process ends; getrusage would tell the parent's too."""

    def look() -> None:
        while True:
            peak_mib()
            time.sleep(0.3)

    threading.Thread(target=look, daemon=True).start()


def timed(report: dict[str, Any], name: str, function: Any, clock: Any = time.process_time) -> Any:
    """The function, its seconds by `clock` (of the CPU) and the peak memory until its end in `report`."""

    def call(*args: Any, **options: Any) -> Any:
        start = clock()
        out = function(*args, **options)
        report[f"{name}_s"] = report.get(f"{name}_s", 0.0) + clock() - start
        report[f"{name}_mib"] = peak_mib()
        return out

    return call


def calibrate_in_parts(folder: Path, given: bool, max_views: int | None) -> dict[str, Any]:
    """Seconds and memory of reading, preparation, solution and the rest."""
    report: dict[str, Any] = {}
    recording = open_recording(folder)
    views = timed(report, "read", read_corners)(folder / "corners.csv")
    over = {} if max_views is None else {"max_views": max_views}
    with (
        mock.patch.object(pipeline, "prepare_views", timed(report, "preparation", pipeline.prepare_views)),
        mock.patch.object(estimators, "bundle", timed(report, "solve", estimators.bundle)),
        mock.patch.object(Recording, "digest", timed(report, "digest", Recording.digest)),
    ):
        result = timed(report, "all", pipeline.calibrate)(
            recording,
            load_config(None, **over),
            intrinsics=folder / "intrinsics.yaml" if given else None,
            detections=Detections(views, ()),
        )
    quality = result.rig.quality
    report |= {"views": len(views), "used": sum(quality.views_used.values()), "rounds": len(quality.rounds)}
    report["expected_mm"] = quality.expected_mm
    selected = quality.frame_selection
    report["expected_mm_with_all"] = quality.expected_mm if selected is None else selected.expected_mm_with_all
    return report


def detect_only(folder: Path, jobs: int) -> dict[str, Any]:
    """Seconds and memory of the detection of all images."""
    report: dict[str, Any] = {}
    recording = open_recording(folder)
    timed(report, "detection", detect, time.perf_counter)(recording, DetectParams(), Workers(jobs))
    report["images"] = sum(map(len, recording.color_files.values()))
    return report


def fresh(**work: Any) -> dict[str, Any]:
    """`work` in a process of its own, so that its peak memory is its own."""
    done = subprocess.run(
        [sys.executable, __file__],
        env=os.environ | {FRESH: json.dumps(work)},
        stdout=subprocess.PIPE,
        check=True,
        start_new_session=True,
    )
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


@click.command(help=__doc__)
@click.option("--frames", multiple=True, type=int, default=(250, 500, 1000), show_default=True)
@click.option("--cameras", type=int, default=8, show_default=True)
@click.option("--part", type=int, default=16, show_default=True, help="One in so many frames is looked at as images.")
@click.option("--jobs", type=int, default=2, show_default=True)
@click.option("--max-views", type=int, help="As in `rgbd-calib calibrate`.")
@click.option("--given/--own-lenses", default=False, help="Lenses from a file, or from the recording's own views.")
@click.option("--seed", type=int, default=0, show_default=True)
@click.option("--json", "as_json", is_flag=True)
def main(
    frames: tuple[int, ...],
    cameras: int,
    part: int,
    jobs: int,
    max_views: int | None,
    given: bool,
    seed: int,
    as_json: bool,
) -> None:
    rows = []
    with tempfile.TemporaryDirectory() as place:
        session = Path(place) / "session"
        session.mkdir()
        params = SimulationParams(cameras=2, frames=4, intrinsic_views=0, distances_m=(), board=BOARD)
        simulate(session, params, 1, lambda items, total, what: iter(items))
        for n in frames:
            folders = {size: Path(place) / f"{size}" for size in {n, n // part}}
            for size, folder in folders.items():
                if not folder.exists():
                    make(folder, session / "extrinsic", cameras, size, seed)
            row = {"cameras": cameras, "frames": n}
            row |= fresh(folder=str(folders[n // part]), jobs=jobs)
            row |= fresh(folder=str(folders[n]), given=given, max_views=max_views)
            rows.append(row)
            if not as_json:
                click.echo(table_row(row, first=len(rows) == 1))
    if as_json:
        click.echo(json.dumps(rows, indent=2))


def table_row(row: dict[str, Any], first: bool) -> str:
    head = (
        "| frames | views | images | detection s | MiB | preparation s | MiB | solve s | MiB | digest s | all s | MiB "
        "| expected mm | with all |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n"
    )
    cells = [f"{row['cameras']} x {row['frames']}", f"{row['used']} of {row['views']}", str(row["images"])]
    for key in ("detection_s", "detection_mib", "preparation_s", "preparation_mib", "solve_s", "solve_mib"):
        cells.append(f"{row[key]:.{1 if key.endswith('_s') else 0}f}")
    cells += [f"{row['digest_s']:.1f}", f"{row['all_s']:.1f}", f"{row['all_mib']:.0f}"]
    cells += [f"{row[key]:.3f}" for key in ("expected_mm", "expected_mm_with_all")]
    return (head if first else "") + "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    if FRESH in os.environ:
        asked = json.loads(os.environ[FRESH])
        asked["folder"] = Path(asked["folder"])
        watch()
        print(json.dumps(detect_only(**asked) if "jobs" in asked else calibrate_in_parts(**asked)))
    else:
        main()

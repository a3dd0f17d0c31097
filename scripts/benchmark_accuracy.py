"""Alignment of the bundle against OpenCV's chain and mrcal, on simulated recordings, over seeds: for the README's table.

    python scripts/benchmark_accuracy.py --work /tmp/accuracy --json > accuracy.json

On this program's corners as found; on the same with white noise on top, since real lenses, boards and hands leave 0.1 px
and more where a simulated image leaves 0.02 px; and on those of OpenCV's findChessboardCornersSB as they come, which is what
a chain written around OpenCV has. OpenCV's chain: calibrateCamera on each camera's close views, PnP of each board, relative poses averaged robustly along
the graph of pairs. mrcal (Debian's package `mrcal`, skipped where it is absent): joint intrinsics and extrinsics on the
same corners. These two have no depth of their own: they are given the bias of the walls, at the middle of the image. Boards,
depth and registration err as real ones do; with --ideal none does. Recordings are rendered once into --work and used again.
"""

from __future__ import annotations

import ast
import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import click
import cv2
import numpy as np

from rgbd_calib.cli.options import progress
from rgbd_calib.geometry import camera, se3
from rgbd_calib.io.correspondences import write_corners
from rgbd_calib.io.recording import Recording, open_recording
from rgbd_calib.io.rig import read_boards, read_rig
from rgbd_calib.pipeline.calibrate import calibrate
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.detection import Detections, Progress, board_of, detect, detections_from
from rgbd_calib.pipeline.evaluate import against_truth
from rgbd_calib.types import BoardView, Rig, RigCamera
from rgbd_calib.views.detect import DetectParams, corner_depth, orient

LAYOUTS = {
    "4 on an arc": ["--cameras", "4", "--layout", "arc"],
    "4 in a ring": ["--cameras", "4", "--layout", "ring"],
    "2 cameras": ["--cameras", "2", "--layout", "arc"],
    "8 in a ring": ["--cameras", "8", "--layout", "ring"],
}


@click.command()
@click.option("--work", type=click.Path(path_type=Path), required=True, help="Where recordings are kept.")
@click.option("--seeds", default=5, show_default=True)
@click.option("--layout", "layouts", multiple=True, type=click.Choice(list(LAYOUTS)), help="[default: all]")
@click.option("--ideal", is_flag=True, help="Perfect prints, flat depth, exact registration.")
@click.option("--json", "as_json", is_flag=True, help="Print the rows as JSON.")
def main(work: Path, seeds: int, layouts: tuple[str, ...], ideal: bool, as_json: bool) -> None:
    rows = []
    for seed in range(seeds):
        for layout in layouts or LAYOUTS:
            rows.append(measure(work, layout, seed, ideal))
            click.echo(json.dumps(rows[-1]), err=True)
    if as_json:
        click.echo(json.dumps(rows, indent=1))
        return
    click.echo(
        "| rig | corners | bundle, mm: median (worst) | stated | OpenCV chain | mrcal | NEES per degree of freedom |"
    )
    click.echo("|---|---|---|---|---|---|---|")
    for layout in layouts or LAYOUTS:
        mine = [row for row in rows if row["layout"] == layout]

        def column(key: str, mine: list[dict] = mine) -> np.ndarray:
            return np.array([row[key] for row in mine if row[key] is not None] or [np.nan])

        for corners in CORNERS:
            ours, stated, opencv, mrcal, nees = (
                column(f"{what} {corners}") for what in ("bundle_mm", "stated_mm", "opencv_mm", "mrcal_mm", "nees")
            )
            click.echo(
                f"| {layout} | {corners} | {np.median(ours):.2f} ({ours.max():.2f}) | {np.median(stated):.2f} | {np.median(opencv):.2f} | "
                f"{np.median(mrcal):.2f} | {nees.mean():.2f} |"
            )


def measure(work: Path, layout: str, seed: int, ideal: bool) -> dict:
    """One row: alignment in mm of the three, and the bundle's NEES, on one simulated recording."""
    folder = work / f"{layout.replace(' ', '_')}_{seed}{'_ideal' * ideal}"
    if not folder.exists():
        command = [sys.executable, "-m", "rgbd_calib", "simulate", str(folder), *["--ideal"] * ideal]
        subprocess.run([*command, "--seed", str(seed), *LAYOUTS[layout]], check=True)
    extrinsic, intrinsic = open_recording(folder / "extrinsic"), open_recording(folder / "intrinsic")
    truth, boards = read_rig(folder / "truth.yaml"), read_boards(folder / "truth.yaml")
    board = board_of(extrinsic)
    boards = {frame: T for frame, T in boards.items() if frame in extrinsic.frames}

    def alignment_mm(rig: Rig | None) -> float | None:
        return None if rig is None else 1e3 * float(against_truth(rig, truth, boards, board).distance_m.mean())

    row: dict = {"layout": layout, "seed": seed}
    for corners, (find, noise_px) in CORNERS.items():
        rng = np.random.default_rng(seed)
        found, close = (noisy(stored(one, folder, find), noise_px, rng) for one in (extrinsic, intrinsic))
        start = time.perf_counter()
        result = calibrate(
            extrinsic,
            Config(),
            intrinsics=folder / "intrinsic",
            depth_bias=folder / "depth_bias",
            detections=found,
            intrinsic_detections=close,
        )
        row[f"seconds_without_detection {corners}"] = time.perf_counter() - start
        row[f"bundle_mm {corners}"] = alignment_mm(result.rig)
        row[f"stated_mm {corners}"] = result.rig.quality.expected_alignment.mean_mm
        row[f"opencv_mm {corners}"] = alignment_mm(opencv_chain(result))
        row[f"mrcal_mm {corners}"] = alignment_mm(mrcal_rig(result, board, close))
        row[f"nees {corners}"] = nees(result, truth)
    return row


def noisy(found: Detections, sigma_px: float, rng: np.random.Generator) -> Detections:
    """The same views with white noise on their corners."""
    views = (replace(v, corners_px=v.corners_px + rng.normal(0, sigma_px, v.corners_px.shape)) for v in found.views)
    return replace(found, views=tuple(views))


def stored(recording: Recording, folder: Path, find: Callable[..., Detections]) -> Detections:
    """Corners of a recording, found once and kept beside it."""
    path = folder / f"{recording.path.name}.{find.__name__}.csv"
    if not path.exists():
        write_corners(path, find(recording, DetectParams(), progress=progress).views)
    return detections_from(recording, path, DetectParams(), None, progress)


def opencv_detect(recording: Recording, params: DetectParams, progress: Progress) -> Detections:
    """OpenCV's sector-based finder as it comes, its corners only put into this program's order."""
    board = board_of(recording)
    views, missed = [], []
    images = [(name, frame) for name, files in recording.color_files.items() for frame in files]
    for name, frame in progress(images, len(images), "OpenCV's corners"):
        gray = cv2.cvtColor(recording.color(name, frame), cv2.COLOR_BGR2GRAY)
        ok, corners = cv2.findChessboardCornersSB(gray, (board.cols, board.rows), flags=0)
        if not ok:
            missed.append((name, frame))
            continue
        corners_px = orient(gray, corners.reshape(board.rows, board.cols, 2).astype(float)).reshape(-1, 2)
        ids = np.arange(board.n_corners)
        depth = corner_depth(recording.depth_m(name, frame), board, ids, corners_px, np.random.default_rng(0))
        views.append(BoardView(name, frame, ids, corners_px, *depth))
    return Detections(tuple(views), tuple(missed))


CORNERS = {
    "ours": (detect, 0.0),
    "ours + 0.1 px": (detect, 0.1),
    "ours + 0.3 px": (detect, 0.3),
    "OpenCV's": (opencv_detect, 0.0),
}
"""Whose corners: by which finder, and the white noise added to them, px."""


def nees(result, truth: Rig) -> float:
    """Squared error of all poses against their joint covariance, over its degrees of freedom."""
    errors = []
    names = [name for name in result.rig.cameras if name != result.rig.reference]
    for name in names:
        errors.append(se3.difference(truth.cameras[name].T_world_color, result.rig.cameras[name].T_world_color))
    index = np.concatenate([result.joint.parameters[name]["pose"] for name in names])
    error = np.concatenate(errors)
    return float(error @ np.linalg.solve(result.joint.matrix[np.ix_(index, index)], error) / len(error))


def opencv_chain(result) -> Rig:
    """Zhang's intrinsics, and the relative poses of single views averaged along the graph of pairs."""
    views = result.views
    cameras = {
        name: RigCamera(lens, views.association.T_world_color[name], np.zeros((6, 6)), views.depth.biases.get(name))
        for name, lens in views.lenses.intrinsics.items()
    }
    return Rig(result.rig.reference, cameras)


def mrcal_rig(result, board, close) -> Rig | None:
    """mrcal's joint solution on the same corners; corners of the back are carried to the front first."""
    program = shutil.which("mrcal-calibrate-cameras")
    if program is None:
        return None
    names = list(result.rig.cameras)
    lenses = result.views.lenses.intrinsics
    lines, frame_numbers = ["# filename x y level"], {}

    def add(name: str, frame: str, corners: np.ndarray, pixels: np.ndarray) -> None:
        number = frame_numbers.setdefault(frame, len(frame_numbers))
        grid = np.full((board.n_corners, 2), np.nan)
        grid[corners] = pixels
        for u, v in grid:
            place = f"{u:.6f} {v:.6f} 0" if np.isfinite(u) else "0 0 -"  # level "-": not detected
            lines.append(f"cam{names.index(name)}-{number:05d}.png {place}")

    for placed in result.views.association.views:
        vector = lenses[placed.view.camera].vector
        on_board = placed.points_m(board)
        p_back, p_front = (se3.transform(placed.T_color_board, p) for p in (on_board, on_board * [1, 1, 0]))
        pixels = placed.view.corners_px + camera.project(vector, p_front) - camera.project(vector, p_back)
        add(placed.view.camera, placed.view.frame, placed.front_corner(board), pixels)
    for view in close.views:
        add(view.camera, f"{view.camera} alone {view.frame}", view.ids, view.corners_px)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "corners.vnl").write_text("\n".join(lines) + "\n")
        size = next(iter(lenses.values()))
        options = ["--corners-cache", "corners.vnl", "--lensmodel", "LENSMODEL_OPENCV5", "--focal", "550"]
        options += ["--object-spacing", str(board.square_m), "--object-width-n", str(board.cols)]
        options += ["--object-height-n", str(board.rows), "--imagersize", str(size.width), str(size.height)]
        globs = [f"cam{i}-*.png" for i in range(len(names))]
        done = subprocess.run(
            [program, *options, "--outdir", ".", *globs], cwd=folder, capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise click.ClickException(f"mrcal failed: {done.stderr[-2000:]}")
        models = [_cameramodel(next(Path(folder).glob(f"*-{i}.cameramodel"))) for i in range(len(names))]
    T_reference = se3.inverse(models[names.index(result.rig.reference)][1])
    cameras = {
        name: RigCamera(
            replace(lenses[name]).with_vector(np.r_[core[:4], core[4:9]]),
            se3.inverse(T_reference) @ se3.inverse(T_camera_ref),
            np.zeros((6, 6)),
            result.views.depth.biases.get(name),
        )
        for name, (core, T_camera_ref) in zip(names, models, strict=True)
    }
    return Rig(result.rig.reference, cameras)


def _cameramodel(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics fx fy cx cy k1 k2 p1 p2 k3, and T_camera_ref, of a mrcal model."""
    from rgbd_calib.geometry import so3

    text = re.sub(r"^\s*#.*$", "", path.read_text(), flags=re.MULTILINE)
    data = ast.literal_eval(re.sub(r"'\w+':\s*b'(?:[^'\\]|\\.)*',?", "", text).strip())
    rt = np.array(data.get("rt_cam_ref", data.get("extrinsics")))
    return np.array(data["intrinsics"]), se3.make(so3.exp(rt[:3]), rt[3:])


if __name__ == "__main__":
    main()

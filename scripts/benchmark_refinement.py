"""Times the refinement against native Ceres on the same problem, start and minimum, and shows how it grows.

Needs a C++ compiler, cmake and libceres-dev (Debian). Ours is the time from arrays and a start to the minimum: grouping,
moments and iterations; with Ceres it is ceres::Solve alone, without the building of its problem.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # ours is timed on one thread; two gain little at these sizes

import json
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.rig.biobjective import RefinementParams, groups, refine
from rgbd_calib.rig.biobjective import problem as problems
from rgbd_calib.rig.biobjective.loss import Loss
from rgbd_calib.rig.biobjective.moments import MomentTerm
from rgbd_calib.rig.biobjective.solver import RefinementMinimum, RefinementState, minimise
from rgbd_calib.rig.biobjective.terms import PixelTerm
from rgbd_calib.types import Correspondences

SIZES = ((2, 100, 100), (4, 100, 100), (4, 1_000, 1_000), (4, 10_000, 10_000), (8, 20_000, 20_000), (32, 2_000, 2_000))
SIGMA_2D_PX, SIGMA_3D_M = 1.0, 0.018
TOLERANCE = CERES_TOLERANCE = 1e-10
"""Relative decrease of the cost at which either stops."""

MODEL = Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5)
PARAMS = RefinementParams(sigma_2d_px=SIGMA_2D_PX, sigma_3d_m=SIGMA_3D_M)

Case = tuple[Correspondences, dict[str, Intrinsics], dict[str, np.ndarray]]


def simulate(cameras: int, points_2d: int, points_3d: int, rng: np.random.Generator) -> Case:
    """Cameras on an arc of 2.5 m around a cloud of points that all of them see; starts off by 0.02 rad and 0.02 m."""
    angles = np.linspace(-0.6, 0.6, cameras)
    R = so3.exp(np.stack([0 * angles, angles, 0 * angles], axis=1))
    T_world_color = se3.make(R, -2.5 * R[:, :, 2])
    T_world_color = se3.inverse(T_world_color[0]) @ T_world_color
    X = rng.uniform([-0.7, -0.6, 1.8], [0.7, 0.6, 3.2], (points_2d + points_3d, 3))
    p = np.concatenate([se3.transform(T, X) for T in se3.inverse(T_world_color)]).reshape(cameras, -1, 3)
    number = np.repeat(np.arange(cameras), points_2d), np.repeat(np.arange(cameras), points_3d)
    pixels = MODEL.project(p[:, :points_2d].reshape(-1, 3))
    names = tuple(f"C{i + 1}" for i in range(cameras))
    data = Correspondences(
        names,
        tuple(("0", str(i)) for i in range(points_2d + points_3d)),
        number[0],
        np.tile(np.arange(points_2d), cameras),
        pixels + rng.normal(0, SIGMA_2D_PX, pixels.shape),
        number[1],
        np.tile(np.arange(points_3d) + points_2d, cameras),
        p[:, points_2d:].reshape(-1, 3) + rng.normal(0, SIGMA_3D_M, (cameras * points_3d, 3)),
    )
    T_world_color[1:] = se3.retract(T_world_color[1:], rng.normal(0, 0.02, (cameras - 1, 6)))
    return data, dict.fromkeys(names, MODEL), dict(zip(names, T_world_color, strict=True))


def hide(case: Case, visible: float, rng: np.random.Generator) -> Case:
    """The same problem with a share of its observations left out, and points that less than two cameras see."""
    data, intrinsics, T_world_color = case
    rows = []
    for cameras, points in ((data.pixel_camera, data.pixel_point), (data.xyz_camera, data.xyz_point)):
        seen = rng.random(len(cameras)) < visible
        rows.append(seen & (np.bincount(points[seen], minlength=len(data.labels))[points] >= 2))
    used = np.unique(np.concatenate([data.pixel_point[rows[0]], data.xyz_point[rows[1]]]))
    left = Correspondences(
        data.cameras,
        tuple(data.labels[i] for i in used),
        data.pixel_camera[rows[0]],
        np.searchsorted(used, data.pixel_point[rows[0]]),
        data.pixels_px[rows[0]],
        data.xyz_camera[rows[1]],
        np.searchsorted(used, data.xyz_point[rows[1]]),
        data.xyz_m[rows[1]],
    )
    return left, intrinsics, T_world_color


@dataclass(frozen=True)
class Start:
    """What both programs are given: poses (N, 4, 4) and the latent points (labels, 3), metres in the world."""

    T: np.ndarray
    points_m: np.ndarray


def start_of(case: Case) -> Start:
    """Points triangulated from the starting poses, or the mean of their measurements."""
    data, intrinsics, T_world_color = case
    problem = problems.build(data, intrinsics, T_world_color, "C1", PARAMS)
    points_m = np.full((len(data.labels), 3), np.nan)
    for grouping, X in problems.point_sets(problem, problem.start, data):
        points_m[grouping.labels] = X.T
    return Start(problem.start.T, points_m)


def solve(case: Case, start: Start, tolerance: float = TOLERANCE) -> RefinementMinimum:
    """Ours, from arrays and a start to the minimum."""
    data, intrinsics, _ = case
    n = len(data.cameras)
    pixels = groups.by_visibility(data.pixel_camera, data.pixel_point, n)
    xyz = groups.by_visibility(data.xyz_camera, data.xyz_point, n)
    terms = (
        PixelTerm(pixels, data.pixels_px, tuple(intrinsics.values()), Loss()),
        MomentTerm(xyz, data.xyz_m, start.T, pairs=False),
    )
    for term, sigma in zip(terms, (SIGMA_2D_PX, SIGMA_3D_M), strict=True):
        term.set_sigmas(np.full(n, sigma))
    X = np.ascontiguousarray(start.points_m[pixels.labels].T)
    return minimise(terms, RefinementState(start.T, (X, np.empty((3, 0)))), False, tolerance, 100)


def write(path: Path, case: Case, start: Start) -> None:
    """The problem as ceres_refinement.cpp reads it."""
    data, _, _ = case
    T_color_world = se3.inverse(start.T)
    with path.open("wb") as file:
        np.array([len(data.cameras), len(data.labels), len(data.pixels_px), len(data.xyz_m)], np.int64).tofile(file)
        for values in (
            np.array([SIGMA_2D_PX, SIGMA_3D_M]),
            np.tile(MODEL.vector[:4], (len(data.cameras), 1)),
            np.hstack([so3.log(T_color_world[:, :3, :3]), T_color_world[:, :3, 3]]),
            start.points_m,
            np.stack([data.pixel_camera, data.pixel_point], axis=1).astype(np.int64),
            data.pixels_px,
            np.stack([data.xyz_camera, data.xyz_point], axis=1).astype(np.int64),
            data.xyz_m,
        ):
            np.ascontiguousarray(values).tofile(file)


def build_ceres(folder: Path) -> Path:
    """Compile the C++ program, optimised."""
    source = Path(__file__).parent
    for command in (
        ["cmake", "-S", source, "-B", folder, "-DCMAKE_BUILD_TYPE=Release"],
        ["cmake", "--build", folder],
    ):
        done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False)
        if done.returncode:
            raise click.ClickException(
                f"Ceres could not be built; it needs cmake, g++ and libceres-dev.\n{done.stderr}"
            )
    return folder / "ceres_refinement"


def ceres(
    program: Path, problem: Path, threads: int, repeats: int, tolerance: float = CERES_TOLERANCE
) -> tuple[float, float]:
    """Best seconds, and cost."""
    command = [str(program), str(problem), str(threads), str(repeats), str(tolerance)]
    seconds, cost, _ = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    return float(seconds), float(cost)


def best_of(repeats: int, run: Callable[[], Any]) -> tuple[float, Any]:
    """Least seconds of several runs after a first one, and what the last returned."""
    run()
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        out = run()
        seconds.append(time.perf_counter() - begin)
    return min(seconds), out


def compare(size: tuple[int, int, int], program: Path, folder: Path, repeats: int) -> dict[str, float]:
    """One row; rounds of the programs alternate, so that load on the machine falls on all of them."""
    cameras, points_2d, points_3d = size
    case = simulate(cameras, points_2d, points_3d, np.random.default_rng(0))
    start = start_of(case)
    problem = folder / "problem.bin"
    write(problem, case, start)
    ours, ceres_1, ceres_2, whole = [], [], [], []
    for _ in range(repeats):
        seconds, minimum = best_of(3, lambda: solve(case, start))
        ours.append(seconds)
        seconds, cost = ceres(program, problem, 1, 3)
        ceres_1.append(seconds)
        ceres_2.append(ceres(program, problem, 2, 3)[0])
    whole.append(best_of(2, lambda: refine(*case, "C1", PARAMS))[0])
    return {
        "cameras": cameras,
        "points_2d": points_2d,
        "points_3d": points_3d,
        "ours_s": min(ours),
        "ceres_1_s": min(ceres_1),
        "ceres_2_s": min(ceres_2),
        "cost_rel_diff": abs(minimum.cost - cost) / cost,
        "refine_s": min(whole),
    }


def minima(n: int, program: Path, folder: Path) -> list[dict[str, float]]:
    """Random problems of 2 to 8 cameras with 60 to 100 % of the observations, each solved by both to the last digit."""
    rows = []
    for seed in range(n):
        rng = np.random.default_rng(seed)
        size = int(rng.integers(2, 9)), int(rng.integers(20, 500)), int(rng.integers(20, 500))
        visible = rng.uniform(0.6, 1.0)
        case = hide(simulate(*size, rng), visible, rng)
        start = start_of(case)
        write(folder / "problem.bin", case, start)
        ours, theirs = solve(case, start, 1e-15).cost, ceres(program, folder / "problem.bin", 1, 1, 1e-15)[1]
        rows.append(
            {
                "seed": seed,
                "cameras": size[0],
                "visible": round(visible, 2),
                "pixels": len(case[0].pixels_px),
                "xyz": len(case[0].xyz_m),
                "cost": ours,
                "cost_rel_diff": abs(ours - theirs) / theirs,
            }
        )
    return rows


def growth(path: Path, repeats: int) -> str:
    """Seconds against points (4 cameras) and against cameras (1,000 points), drawn on log axes; the slopes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    slopes = []
    points = [300 * 4**i for i in range(6)]
    cameras = [2, 4, 8, 16, 32, 64]
    sweeps = (
        ("points (4 cameras)", points, [(4, n, n) for n in points]),
        ("cameras (1,000 points)", cameras, [(c, 1000, 1000) for c in cameras]),
    )
    for ax, (name, values, sizes) in zip(axes, sweeps, strict=True):
        seconds = []
        for size in sizes:
            case = simulate(*size, np.random.default_rng(0))
            start = start_of(case)
            seconds.append(best_of(repeats, lambda case=case, start=start: solve(case, start))[0])
        slopes.append(np.polyfit(np.log(values[-3:]), np.log(seconds[-3:]), 1)[0])
        ax.loglog(values, seconds, "o-")
        ax.set(xlabel=name, ylabel="seconds", title=f"exponent at the end {slopes[-1]:.2f}")
        ax.set_xticks(values, [f"{v:,}" for v in values], minor=False)
        ax.set_xticks([], minor=True)
        ax.grid(alpha=0.3)
    figure.savefig(path, dpi=80)
    return f"time grows as points^{slopes[0]:.2f} and cameras^{slopes[1]:.2f} ({path})"


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print the rows as JSON.")
@click.option(
    "--repeats", type=click.IntRange(1), default=5, show_default=True, help="Alternating rounds; the best counts."
)
@click.option("--growth", "picture", type=click.Path(path_type=Path), help="Also time the growth, and draw it here.")
@click.option("--minima", "n_minima", type=int, help="Instead: compare the minima of this many random problems.")
def main(as_json: bool, repeats: int, picture: Path | None, n_minima: int | None) -> None:
    """Time the refinement against native Ceres."""
    with tempfile.TemporaryDirectory() as name:
        program = build_ceres(Path(name) / "build")
        if n_minima is not None:
            found = minima(n_minima, program, Path(name))
            for row in found:
                click.echo(json.dumps(row))
            click.echo(
                f"largest relative difference of the cost: {max(r['cost_rel_diff'] for r in found):.1e}", err=True
            )
            return
        rows = []
        for size in SIZES:
            rows.append(compare(size, program, Path(name), repeats))
            click.echo(f"{len(rows)} of {len(SIZES)} done", err=True)
    if as_json:
        click.echo(json.dumps(rows, indent=1))
    else:
        click.echo(
            "| cameras x 2D x 3D | ours | Ceres 1 thread | Ceres 2 threads | best Ceres / ours | refine(), whole | cost differs |"
        )
        click.echo("|---|---|---|---|---|---|---|")
        for r in rows:
            faster = min(r["ceres_1_s"], r["ceres_2_s"]) / r["ours_s"]
            click.echo(
                f"| {r['cameras']} x {r['points_2d']:,} x {r['points_3d']:,} | {r['ours_s']:.4f} | {r['ceres_1_s']:.4f} | "
                f"{r['ceres_2_s']:.4f} | {faster:.1f} | {r['refine_s']:.4f} | {r['cost_rel_diff']:.0e} |"
            )
    if picture:
        click.echo(growth(picture, repeats), err=True)


if __name__ == "__main__":
    main()

"""How long each stage of a calibration takes, images included, on one core: for the README's table.

rgbd-calib simulate SIMULATION && python scripts/benchmark_stages.py SIMULATION
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from rgbd_calib.io.recording import open_recording
from rgbd_calib.pipeline import calibrate, checked_views, details, estimators, prepare
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.workers import Workers
from rgbd_calib.trust.self_check import calibration as self_check

STAGES: dict[str, list[tuple[Any, str]]] = {
    "corners and their depth": [(checked_views, "detect"), (prepare, "detect")],
    "intrinsics (start)": [(prepare, "calibrate_intrinsics")],
    "depth bias": [(prepare, "depth_of_recording")],
    "plane filter": [(checked_views, "filter_planes")],
    "board poses": [(checked_views, "pose_view")],
    "association": [(checked_views, "associate")],
    "bundle": [(estimators, "bundle")],
    "expected error, first rig": [(details, "expectation"), (details, "starting_rig")],
    "error on the recording": [(calibrate, "common_corners")],
    "self-checks": [(self_check, "of_calibration")],
}


class Clock:
    """Seconds spent in each stage, without the stages that it calls."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(STAGES, 0.0)
        self._inner = [0.0]

    def timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **kwargs: Any) -> Any:
            self._inner.append(0.0)
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                spent = time.perf_counter() - start
                self.seconds[stage] += spent - self._inner.pop()
                self._inner[-1] += spent

        return run


@click.command()
@click.argument("simulation", type=click.Path(exists=True, path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print the rows as JSON.")
def main(simulation: Path, as_json: bool) -> None:
    """Time the stages of `calibrate` on a folder of `rgbd-calib simulate`."""
    clock = Clock()
    for stage, functions in STAGES.items():
        for module, name in functions:
            setattr(module, name, clock.timed(stage, getattr(module, name)))
    folders = {name: open_recording(simulation / name) for name in ("extrinsic", "intrinsic", "depth_bias")}
    start = time.perf_counter()
    calibrate.calibrate(
        folders["extrinsic"],
        Config(),
        intrinsics=simulation / "intrinsic",
        depth_bias=simulation / "depth_bias",
        workers=Workers(jobs=1),
    )
    total = time.perf_counter() - start
    rows = clock.seconds | {"everything else": total - sum(clock.seconds.values())}
    if as_json:
        click.echo(json.dumps({"total_s": total, "stages_s": rows}, indent=1))
        return
    counts = {name: sum(map(len, one.color_files.values())) for name, one in folders.items()}
    click.echo(f"{len(folders['extrinsic'].cameras)} cameras, images: {counts}; {total:.1f} s on one core\n")
    click.echo("| stage | seconds | share |\n|---|---|---|")
    for stage, seconds in rows.items():
        click.echo(f"| {stage} | {seconds:.2f} | {seconds / total:.0%} |")


if __name__ == "__main__":
    main()

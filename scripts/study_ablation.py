"""What each unknown of board and depth brings: one block after the other held at zero, for docs/accuracy.md.

python scripts/study_ablation.py SIMULATION        (a folder that `rgbd-calib simulate` made)
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click
import numpy as np
from benchmark_accuracy import nees
from study_robustness import alignment_mm

from rgbd_calib.cli.options import progress
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_rig
from rgbd_calib.pipeline.calibrate import calibrate
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.detection import detect
from rgbd_calib.types import Rig
from rgbd_calib.views.detect import DetectParams

BLOCKS = ("print", "corner offsets", "bow", "back sheet", "registration", "depth field", "tape")
NEAREST_M, FARTHEST_M = 0.8, 3.0


@click.command()
@click.argument("simulation", type=click.Path(path_type=Path))
def main(simulation: Path) -> None:
    extrinsic, intrinsic = open_recording(simulation / "extrinsic"), open_recording(simulation / "intrinsic")
    found, close = (detect(one, DetectParams(), progress=progress) for one in (extrinsic, intrinsic))
    truth = read_rig(simulation / "truth.yaml")
    click.echo("| held at zero | alignment, mm | stated | NEES | depth left, mm RMS |")
    click.echo("|---|---|---|---|---|")
    for hold in ((), *((name,) for name in BLOCKS), BLOCKS):
        config = replace(Config(), bundle=replace(Config().bundle, hold=hold))
        result = calibrate(
            extrinsic,
            config,
            intrinsics=simulation / "intrinsic",
            depth_bias=simulation / "depth_bias",
            detections=found,
            intrinsic_detections=close,
        )
        mm = alignment_mm(simulation, extrinsic, result)
        stated = result.rig.quality.expected_alignment.mean_mm
        what = "nothing" if not hold else f"`{hold[0]}`" if len(hold) == 1 else "all of these"
        left = depth_left_mm(result.rig, truth)
        click.echo(f"| {what} | {mm:.2f} | {stated:.2f} | {nees(result, truth):.1f} | {left:.2f} |")


def depth_left_mm(rig: Rig, truth: Rig) -> float:
    """RMS over the images of all cameras and the range."""
    left = []
    for name, own in rig.cameras.items():
        lens = own.intrinsics
        u, v = np.meshgrid(np.linspace(5, lens.width - 6, 20), np.linspace(5, lens.height - 6, 15))
        pixels = np.column_stack([u.ravel(), v.ravel()])
        for z_m in np.linspace(NEAREST_M, FARTHEST_M, 8):
            raw_m = np.full(len(pixels), z_m)
            placed = (r.cameras[name].depth_sensor.points(pixels, raw_m)[:, 2] for r in (truth, rig))
            left.append(np.subtract(*placed))
    return 1e3 * float(np.sqrt(np.mean(np.concatenate(left) ** 2)))


if __name__ == "__main__":
    main()

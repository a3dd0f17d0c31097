"""Held-out alignment of a recording: calibrate on four fifths of its frames, measure on the rest, five times.

python scripts/cross_validate.py RECORDING [--method bundle] [--folds 5]
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from rgbd_calib.cli.options import progress
from rgbd_calib.io.recording import open_recording
from rgbd_calib.pipeline.calibrate import calibrate
from rgbd_calib.pipeline.config import load_config
from rgbd_calib.pipeline.detection import Detections, detect
from rgbd_calib.pipeline.evaluate import against_views, place_views
from rgbd_calib.pipeline.rig_inputs import board_for


@click.command()
@click.argument("path", metavar="RECORDING", type=click.Path(path_type=Path))
@click.option("--method", default="bundle", show_default=True)
@click.option("--folds", default=5, show_default=True)
def main(path: Path, method: str, folds: int) -> None:
    recording = open_recording(path)
    config = load_config(None, method=method)
    found = detect(recording, config.detect, progress=progress)
    frames = sorted({view.frame for view in found.views})
    distances, transfers = [], []
    for k in range(folds):
        held = set(frames[k::folds])
        train = Detections(tuple(view for view in found.views if view.frame not in held), ())
        rig = calibrate(recording, config, detections=train).rig
        test = [view for view in found.views if view.frame in held]
        board = board_for(recording, rig)
        evaluation = against_views(rig, place_views(rig, test, board, list(recording.cameras), config), board)
        distances += [pair.distance_m for pair in evaluation.pairs]
        transfers += [pair.transfer_px for pair in evaluation.pairs]
    mm, px = 1e3 * np.concatenate(distances), np.concatenate(transfers)
    click.echo(
        f"{method}, {folds}-fold over {len(frames)} frames: median {np.median(mm):.2f} mm, {np.median(px):.2f} px"
    )
    click.echo(f"mean {mm.mean():.2f} mm, {px.mean():.2f} px; {len(mm)} corners")


if __name__ == "__main__":
    main()

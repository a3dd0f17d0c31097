"""What the bundle makes of spoiled views, and what is lost without a bias or an intrinsic recording: for the README.

python scripts/study_robustness.py SIMULATION [--json]        (a folder that `rgbd-calib simulate` made)
"""

from __future__ import annotations

import json
import shutil
import tempfile
from pathlib import Path
from typing import get_args

import click
import numpy as np

from rgbd_calib.cli.options import progress
from rgbd_calib.io.recording import Recording, open_recording
from rgbd_calib.io.rig import read_boards, read_rig
from rgbd_calib.pipeline.calibrate import Calibration, calibrate
from rgbd_calib.pipeline.config import Config
from rgbd_calib.pipeline.detection import Detections, board_of, detections_from
from rgbd_calib.pipeline.evaluate import against_truth
from rgbd_calib.simulation.spoil import Kind, spoil, true_corners
from rgbd_calib.views.detect import DetectParams


@click.command()
@click.argument("simulation", type=click.Path(path_type=Path))
@click.option("--share", default=0.1, show_default=True, help="Share of the views that are spoiled.")
@click.option("--corners", type=click.Path(path_type=Path), help="corners.csv of SIMULATION/extrinsic.")
@click.option("--intrinsic-corners", type=click.Path(path_type=Path), help="corners.csv of SIMULATION/intrinsic.")
@click.option("--json", "as_json", is_flag=True, help="Print the rows as JSON.")
def main(simulation: Path, share: float, corners: Path | None, intrinsic_corners: Path | None, as_json: bool) -> None:
    clean, intrinsic = open_recording(simulation / "extrinsic"), open_recording(simulation / "intrinsic")
    found = detections_from(clean, corners, DetectParams(), None, progress)
    close = detections_from(intrinsic, intrinsic_corners, DetectParams(), None, progress)
    lens, walls = simulation / "intrinsic", simulation / "depth_bias"
    rows = []

    def add(case: str, recording: Recording, views: Detections, lens: Path | None, walls: Path | None) -> Calibration:
        result = calibrate(
            recording, Config(), intrinsics=lens, depth_bias=walls, detections=views, intrinsic_detections=close
        )
        rows.append({"case": case, "alignment_mm": alignment_mm(simulation, recording, result), **losses(result)})
        click.echo(json.dumps(rows[-1]), err=True)
        return result

    add("clean", clean, found, lens, walls)
    add("without the bias recording", clean, found, lens, None)
    add("without the intrinsic recording", clean, found, None, walls)
    add("without both", clean, found, None, None)
    with tempfile.TemporaryDirectory() as folder:
        for k, kind in enumerate(get_args(Kind)):
            out = Path(folder) / kind
            spoiled = spoil(
                clean.path, out, kind, true_corners(simulation / "true_corners.csv"), share, np.random.default_rng(k)
            )
            recording = open_recording(out)
            views = reuse(recording, found, spoiled)
            result = add(f"10 % {kind}", recording, views, lens, walls)
            named = {(camera, frame) for camera, frames in dropped(result).items() for frame in frames}
            seen = {(view.camera, view.frame) for view in views.views}
            rows[-1] |= {"spoiled": len(spoiled), "found": len(seen & set(spoiled)), "named": len(named & set(spoiled))}
            shutil.rmtree(out)
    if as_json:
        click.echo(json.dumps(rows, indent=1))
        return
    click.echo(
        "| recording | alignment, mm | against clean | spoiled views | board still found in | named | others dropped |"
    )
    click.echo("|---|---|---|---|---|---|---|")
    for row in rows:
        spoilt = [str(row.get(key, "")) for key in ("spoiled", "found", "named")]
        others = row["dropped"] - row.get("named", 0)
        ratio = row["alignment_mm"] / rows[0]["alignment_mm"]
        click.echo(f"| {row['case']} | {row['alignment_mm']:.3f} | {ratio:.2f} | {' | '.join(spoilt)} | {others} |")


def reuse(recording: Recording, found: Detections, spoiled: tuple[tuple[str, str], ...]) -> Detections:
    """Detections of a spoiled copy: only the spoiled views are searched again."""
    from rgbd_calib.views.detect import detect_view

    views = [view for view in found.views if (view.camera, view.frame) not in spoiled]
    for camera, frame in spoiled:
        depth_m = recording.depth_m(camera, frame) if recording.has_depth(camera, frame) else None
        view = detect_view(camera, frame, recording.color(camera, frame), depth_m, board_of(recording), DetectParams())
        views += [view] if view is not None else []
    return Detections(tuple(sorted(views, key=lambda v: (v.camera, v.frame))), ())


def dropped(result: Calibration) -> dict[str, dict[str, str]]:
    """Views, or their depth, that were left out, by camera and frame."""
    quality = result.rig.quality
    out: dict[str, dict[str, str]] = {}
    for part in (quality.views_not_associated, quality.dropped):
        for camera, frames in (part or {}).items():
            out.setdefault(camera, {}).update({f: why for f, why in frames.items() if "alone" not in f})
    return out


def losses(result: Calibration) -> dict[str, int]:
    return {"dropped": sum(len(frames) for frames in dropped(result).values())}


def alignment_mm(simulation: Path, recording: Recording, result: Calibration) -> float:
    """Mean alignment error over the volume where the board was."""
    truth, boards = read_rig(simulation / "truth.yaml"), read_boards(simulation / "truth.yaml")
    mine = {frame: T for frame, T in boards.items() if frame in recording.frames}
    return 1e3 * float(against_truth(result.rig, truth, mine, board_of(recording)).distance_m.mean())


if __name__ == "__main__":
    main()

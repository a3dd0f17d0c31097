"""`rgbd-calib verify`: does a rig still hold?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rgbd_calib.cli.options import config_option, corners_option, progress, say, show, workers_options

if TYPE_CHECKING:
    from rgbd_calib.pipeline.workers import Workers


@click.command
@click.argument("rig_path", metavar="RIG", type=click.Path(path_type=Path))
@click.argument("recording", type=click.Path(path_type=Path))
@click.option(
    "--max-mm",
    type=click.FloatRange(0, min_open=True),
    default=3.0,
    show_default=True,
    help="How far apart two cameras may put the board.",
)
@corners_option
@click.option("--json", "as_json", is_flag=True, help="Print all numbers as JSON.")
@config_option
@workers_options
def command(
    rig_path: Path,
    recording: Path,
    max_mm: float,
    corners: Path | None,
    as_json: bool,
    config: Path | None,
    workers: Workers,
) -> int:
    """Check from a few new frames of the board whether RIG is still valid, and which camera moved.

    Lenses and depth biases are taken as they are; the cameras are posed anew by RECORDING and compared, pair by pair, at
    the places where the board was, noise taken off. Frames that the rig was calibrated from are held out. Five frames for each pair of neighbours are good. Where a camera
    moved, put it back by `calibrate --update --only`.

    \b
    Exit status:
      0  every pair is within --max-mm
      1  a camera moved, or the frames cannot tell (which is said)

    \b
    Examples:
      rgbd-calib verify rig.yaml monday
      rgbd-calib verify rig.yaml monday --max-mm 2 --json
      rgbd-calib verify rig.yaml monday || rgbd-calib calibrate monday --update rig.yaml --only C3 -o rig2.yaml
    """
    from rgbd_calib.io.plain import to_json
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.io.rig import read_rig
    from rgbd_calib.pipeline.config import load_config
    from rgbd_calib.pipeline.depth_cameras import split
    from rgbd_calib.pipeline.detection import detections_from
    from rgbd_calib.pipeline.held_out_frames import frames_of_calibration, refuse_nothing_new
    from rgbd_calib.pipeline.rig_inputs import left_out
    from rgbd_calib.pipeline.verify import summary, verify
    from rgbd_calib.trust.displacement import VerdictParams

    rig, opened, settings = read_rig(rig_path), split(open_recording(recording)), load_config(config)
    if left_out(opened, rig):
        say(left_out(opened, rig))
    used = frames_of_calibration(rig, opened)
    refuse_nothing_new(rig, opened, used)
    if used:
        say(f"Held out: {len(used)} of {len(opened.frames)} frames, which the rig was calibrated from")
    found = detections_from(opened, corners, settings.detect, workers, progress)
    new = [view for view in found.views if view.frame not in used]
    result = verify(rig, opened, new, settings, VerdictParams(max_m=max_mm / 1e3))
    numbers = summary(result)
    if as_json:
        show(to_json(numbers, indent=2))
    else:
        _tell(numbers)
    return 0 if result.verdict.holds else 1


def _tell(numbers: dict[str, Any]) -> None:
    for name, pair in numbers["pairs"].items():
        mark = "  OFF" if pair["off"] else ""
        show(f"{name}: {pair['error_mm']:.2f} ± {pair['noise_mm']:.2f} mm{mark}")
    for name in numbers["moved"]:
        own = numbers["cameras"][name]
        show(
            f"{name} moved: {own['shift_mm']:.2f} ± {own['shift_sd_mm']:.2f} mm, "
            f"{own['turn_deg']:.3f} ± {own['turn_sd_deg']:.3f}° against the others"
        )
    for text in numbers["views_left_out"]:
        say(text)
    show(numbers["verdict"])

"""`rgbd-calib doctor`: what is wrong with a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rgbd_calib.cli.options import (
    config_option,
    corners_option,
    progress,
    recording_argument,
    say,
    show,
    workers_options,
)

if TYPE_CHECKING:
    from rgbd_calib.pipeline.workers import Workers


@click.command
@recording_argument
@click.option(
    "--intrinsics",
    type=click.Path(path_type=Path),
    help="intrinsics.yaml: where it will come from, regions and tilts of RECORDING are not judged.",
)
@corners_option
@click.option("--json", "as_json", is_flag=True, help="Print the findings as JSON.")
@config_option
@workers_options
def command(
    recording: Path,
    intrinsics: Path | None,
    corners: Path | None,
    as_json: bool,
    config: Path | None,
    workers: Workers,
) -> int:
    """Say what is wrong with RECORDING before any calibration, and what to film next.

    Damaged images and wrong sizes; missing frames and depth; exposures that are apart; boards that moved, are blurred,
    covered, over- or underexposed, or no board at all; cameras that share no view; where the board has not been. Every
    view is judged by what is usual in this recording.

    \b
    Exit status:
      0  nothing, or advice only
      1  something that a calibration will suffer from

    \b
    Examples:
      rgbd-calib doctor demo/extrinsic
      rgbd-calib doctor demo/intrinsic --json
      rgbd-calib doctor monday --intrinsics rig.yaml && rgbd-calib calibrate monday --intrinsics rig.yaml -o rig2.yaml
    """
    from dataclasses import asdict

    from rgbd_calib.io.plain import to_json
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.pipeline.config import load_config
    from rgbd_calib.pipeline.doctor import examine

    result = examine(
        open_recording(recording),
        load_config(config),
        intrinsics=intrinsics,
        corners=corners,
        workers=workers,
        progress=progress,
    )
    if as_json:
        show(to_json({"healthy": result.healthy, "findings": [asdict(f) for f in result.findings]}, indent=2))
    else:
        for finding in result.findings:
            show(f"{'!' if finding.matters else '-'} {finding.sentence}")
    serious = sum(f.matters for f in result.findings)
    say(
        f"{result.images} images, the board in {result.views}: "
        + (f"{serious} problem{'s' * (serious != 1)} found" if serious else "no problems found")
        + (f", {len(result.findings) - serious} piece(s) of advice" if len(result.findings) > serious else "")
    )
    return 0 if result.healthy else 1

"""`rgbd-calib intrinsics`: the lens of each camera from views of the board."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rgbd_calib.cli.options import (
    config_option,
    corners_option,
    give,
    json_option,
    lens_option,
    output_option,
    overwrite_option,
    progress,
    recording_argument,
    refuse_existing,
    say,
    show,
    workers_options,
)

if TYPE_CHECKING:
    from rgbd_calib.pipeline.workers import Workers


@click.command()
@recording_argument
@output_option("intrinsics.yaml")
@corners_option
@lens_option
@config_option
@workers_options
@overwrite_option
@json_option
def command(
    recording: Path,
    output: Path,
    corners: Path | None,
    lens: str | None,
    config: Path | None,
    workers: Workers,
    overwrite: bool,
) -> None:
    """Calibrate the intrinsics of each camera from its views of the board in RECORDING (Zhang's method).

    \b
    Examples:
      rgbd-calib intrinsics demo/intrinsic -o intrinsics.yaml
      rgbd-calib detect demo/intrinsic -o corners.csv
      rgbd-calib intrinsics demo/intrinsic --corners corners.csv -o by_corners.yaml
    """
    refuse_existing(output, overwrite)
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.io.rig import write_intrinsics
    from rgbd_calib.pipeline.config import load_config
    from rgbd_calib.pipeline.depth_cameras import split
    from rgbd_calib.pipeline.detection import detections_from
    from rgbd_calib.pipeline.prepare import intrinsics_of_views
    from rgbd_calib.pipeline.provenance import provenance_of

    opened, settings = split(open_recording(recording)), load_config(config, intrinsics__lens=lens)
    found = detections_from(opened, corners, settings.detect, workers, progress)
    seeing = [name for name, files in opened.color_files.items() if files]
    results = intrinsics_of_views(opened, found, settings, seeing)
    statistics = {
        name: {
            "intrinsics_sd": result.standard_deviation,
            "rms_px": result.rms_px,
            "views": len(result.view_rms_px),
            "view_rms_px": result.view_rms_px,
            "dropped": result.dropped,
            "not_needed": len(result.not_needed),
            "lens": result.choice,
        }
        for name, result in results.items()
    }
    provenance = {**provenance_of(settings), "recording": str(recording), "recording_sha256": opened.digest()}
    lenses = {name: result.intrinsics for name, result in results.items()}
    for name, info in opened.cameras.items():
        if info.mount is not None and name in lenses:  # of its infrared images
            own = {"width": info.width, "height": info.height, "intrinsics": asdict(lenses.pop(name))}
            statistics[info.mount.camera] |= {"depth": own, "depth_statistics": statistics.pop(name)}
    write_intrinsics(output, lenses, statistics, {}, provenance)
    for name, result in results.items():
        own, sd = result.intrinsics, result.standard_deviation
        show(
            f"{name}: fx {own.fx:.2f} ± {sd[0]:.2f}, fy {own.fy:.2f} ± {sd[1]:.2f}, cx {own.cx:.2f} ± {sd[2]:.2f}, "
            f"cy {own.cy:.2f} ± {sd[3]:.2f} px; RMS {result.rms_px:.3f} px over {len(result.view_rms_px)} views"
        )
        if result.choice.sentence:
            say(f"{name}: {result.choice.sentence}")
        if result.not_needed:
            say(
                f"{name}: {len(result.not_needed)} more views were not needed: the most informative ones are used (intrinsics.max_views)"
            )
        for frame, why in result.dropped.items():
            say(f"{name}: frame {frame} left out: {why}")
    say(f"Wrote {output}")
    give(
        {
            "output": str(output),
            "cameras": {
                name: {
                    "intrinsics": asdict(result.intrinsics),
                    "sd": result.standard_deviation,
                    "rms_px": result.rms_px,
                    "views": len(result.view_rms_px),
                    "not_needed": len(result.not_needed),
                    "dropped": result.dropped,
                }
                for name, result in results.items()
            },
        }
    )

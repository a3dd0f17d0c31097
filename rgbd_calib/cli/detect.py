"""`rgbd-calib detect`: the board's corners in all images, as a table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rgbd_calib.cli.options import (
    config_option,
    give,
    json_option,
    output_option,
    overwrite_option,
    progress,
    recording_argument,
    refuse_existing,
    say,
    workers_options,
)

if TYPE_CHECKING:
    from rgbd_calib.pipeline.workers import Workers


@click.command()
@recording_argument
@output_option("the corners, a .csv file")
@config_option
@workers_options
@overwrite_option
@json_option
def command(recording: Path, output: Path, config: Path | None, workers: Workers, overwrite: bool) -> None:
    """Find the board of RECORDING in all its images: corners in px, and the depth measured there.

    The other commands detect for themselves; with --corners they take this table instead, which saves the time where
    one recording is used again and again. Depth is as measured, before any correction.

    \b
    Examples:
      rgbd-calib detect demo/extrinsic -o corners.csv
      rgbd-calib calibrate demo/extrinsic --corners corners.csv -o rig.yaml
    """
    refuse_existing(output, overwrite)
    from rgbd_calib.io.correspondences import write_corners
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.pipeline.config import load_config
    from rgbd_calib.pipeline.depth_cameras import split
    from rgbd_calib.pipeline.detection import detect

    opened, settings = split(open_recording(recording)), load_config(config)
    found = detect(opened, settings.detect, workers, progress)
    write_corners(output, found.views)
    cameras = {}
    for camera, files in opened.color_files.items():
        views, missed = found.of(camera), [frame for name, frame in found.missed if name == camera]
        corners = sum(len(view.ids) for view in views)
        with_depth = sum(int((view.depth_pixels > 0).sum()) for view in views)
        say(
            f"{camera}: board in {len(views)} of {len(files)} images, {corners} corners, {with_depth} of them with depth"
            + (f"; not found in {', '.join(missed)}" if missed else "")
        )
        cameras[camera] = {
            "images": len(files),
            "views": len(views),
            "corners": corners,
            "corners_with_depth": with_depth,
            "not_found": missed,
        }
    say(f"Wrote {output}")
    give({"output": str(output), "cameras": cameras})

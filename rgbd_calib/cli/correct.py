"""`rgbd-calib correct`: a recording with its errors removed, for programs that know nothing of them."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from rgbd_calib.cli.options import (
    give,
    jobs_option,
    json_option,
    output_option,
    overwrite_option,
    progress,
    recording_argument,
    refuse_existing,
    say,
    within_range_option,
)


@click.command
@recording_argument
@click.option("--rig", "rig_path", type=click.Path(path_type=Path), required=True, help="The rig file.")
@click.option("--undistort", is_flag=True, help="Also undistort colour and depth, to pinholes with the same K.")
@click.option(
    "--geometry",
    type=click.Choice(["color", "depth"]),
    default="color",
    show_default=True,
    help="Geometry of the corrected depth: of the colour image, or its own, with its calibration in dataset.yaml.",
)
@within_range_option
@jobs_option
@output_option("the corrected recording, a folder")
@json_option
@overwrite_option
@json_option
def command(
    recording: Path,
    rig_path: Path,
    undistort: bool,
    geometry: str,
    within_range: bool,
    jobs: int | None,
    output: Path,
    overwrite: bool,
) -> None:
    """Remove depth bias and distortion from a recording.

    Distortion only with --undistort. OUT is a recording like the one it was made from, with the intrinsics in its dataset.yaml, and with a rig.yaml that
    fits it: no bias any more and, with --undistort, no distortion. Depth keeps its unit and is rounded to it;
    undistorted depth is taken from the nearest pixel, never mixed.

    \b
    Examples:
      rgbd-calib correct demo/extrinsic --rig demo/rig.yaml -o demo/corrected
      rgbd-calib correct demo/extrinsic --rig demo/rig.yaml --undistort -o demo/pinhole
      rgbd-calib correct demo/extrinsic --rig demo/rig.yaml --geometry depth -o demo/own_geometry
      rgbd-calib fuse demo/pinhole --rig demo/pinhole/rig.yaml -o demo/pinhole.ply
    """
    if undistort and geometry == "depth":
        raise click.UsageError("--undistort needs --geometry color: depth in its own geometry keeps its lens")
    refuse_existing(output, overwrite, folder=True)

    from rgbd_calib.io.files import whole_folder
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.io.rig import read_rig
    from rgbd_calib.pipeline.correct import correct
    from rgbd_calib.pipeline.rig_inputs import left_out

    rig = read_rig(rig_path)
    opened = open_recording(recording)
    if left_out(opened, rig):
        say(left_out(opened, rig))
    with whole_folder(output, overwrite) as folder:
        summary = correct(opened, rig, folder, undistort, geometry, within_range, jobs, progress)  # type: ignore[arg-type]
    say(f"Corrected recording, and its rig.yaml -> {output}")
    for camera, done in summary.items():
        bias = "no depth bias in the rig" if rig.cameras[camera].depth_bias is None else "bias removed"
        notes = [f"{done.color_images} colour", f"{done.depth_images} depth images, {bias}"]
        if done.lost_pixels:
            notes.append(f"{done.lost_pixels} depth pixels no longer fit 16 bits and became 0")
        if done.outside_pixels:
            what = "left out" if within_range else "corrected less surely"
            share = done.outside_pixels / done.measured_pixels
            notes.append(f"{share:.1%} of the depth pixels outside the range of the bias's data, {what}")
        say(f"  {camera}: {', '.join(notes)}")
    give({"output": str(output), "cameras": {camera: asdict(done) for camera, done in summary.items()}})

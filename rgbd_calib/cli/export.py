"""`rgbd-calib export`: a rig for another program."""

from __future__ import annotations

from pathlib import Path

import click

from rgbd_calib.cli.options import (
    OUTPUT,
    Number,
    give,
    json_option,
    overwrite_option,
    refuse_existing,
    say,
)

FORMATS = ("ros", "kalibr", "colmap", "nerfstudio", "open3d", "opencv", "mrcal", "json")


@click.command
@click.argument("rig", type=click.Path(path_type=Path))
@click.option("--to", type=click.Choice(FORMATS), required=True, help="The format.")
@click.argument("output", type=OUTPUT)
@click.option(
    "--undistorted", is_flag=True, help="Leave the lens out: for images that `correct --undistort` made (same K)."
)
@click.option(
    "--image-name",
    default="{camera}.png",
    show_default=True,
    help="Name of each camera's image, in the formats that list images (colmap, nerfstudio).",
)
@click.option(
    "--max-px",
    type=Number(0),
    default=0.05,
    show_default=True,
    help="Largest deviation, px, of a lens that is refitted since the format does not have it.",
)
@overwrite_option
@json_option
def command(
    rig: Path, to: str, output: Path, undistorted: bool, image_name: str, max_px: float, overwrite: bool
) -> None:
    """Export a rig for another program.

    \b
      ros         folder: camera_info YAML of each camera, static transforms (ROS 2 launch.py, ROS 1 launch)
      kalibr      camchain.yaml: chain from the reference camera; radtan (no k3) and equidistant
      colmap      folder: text model; pixel centres at 0.5, so cx and cy + 0.5; the rig in rigs.txt
      nerfstudio  transforms.json: OpenGL axes, pixel centres at 0.5
      open3d      PinholeCameraTrajectory, .json: no distortion, so with --undistorted
      opencv      FileStorage, .yml, .xml or .json: everything but the statistics
      mrcal       folder: NAME.cameramodel; OPENCV4, 5, 8 or 12
      json        the rig file as JSON: everything

    A lens that the format does not have is refitted over the image to the nearest one that it has, and the largest and the
    RMS deviation are printed; beyond --max-px the export stops.

    \b
    Examples:
      rgbd-calib export demo/rig.yaml --to ros demo/ros
      rgbd-calib export demo/rig.yaml --to colmap --image-name "{camera}/color/000000.png" demo/sparse
      rgbd-calib export demo/rig.yaml --to open3d --undistorted demo/trajectory.json
    """
    from rgbd_calib.io import exports
    from rgbd_calib.io.exports.common import Options
    from rgbd_calib.io.rig import read_rig

    exports.check_target(output, to)
    refuse_existing(output, overwrite, folder=not exports.FORMATS[to].suffixes)
    result = exports.export(read_rig(rig), to, Options(image_name, undistorted, output.suffix.lower(), max_px))
    exports.write(output, result, overwrite)
    say(f"{to}: {', '.join(name for name in result.files if name) or output.name} -> {output}")
    for note in result.notes:
        say(f"  {note}")
    files = [name for name in result.files if name] or [output.name]
    give({"output": str(output), "format": to, "files": files, "notes": list(result.notes)})

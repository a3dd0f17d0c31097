"""`rgbd-calib import-calibration`: lenses and poses of other programs."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from rgbd_calib.cli.options import (
    give,
    json_option,
    output_option,
    overwrite_option,
    refuse_existing,
    say,
)
from rgbd_calib.errors import ConfigError

UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001}


@click.command
@click.argument("files", nargs=-1, required=True, metavar="[NAME=]FILE...")
@output_option("intrinsics.yaml, or rig.yaml")
@click.option("--rename", multiple=True, metavar="OLD=NEW", help="Call a camera of the files NEW (repeat).")
@click.option("--size", metavar="WIDTHxHEIGHT", help="Size of the images, px, for files that do not say it.")
@click.option(
    "--unit", type=click.Choice(list(UNITS_M)), default="m", show_default=True, help="Of the files' translations."
)
@overwrite_option
@json_option
def command(
    files: tuple[str, ...], output: Path, rename: tuple[str, ...], size: str | None, unit: str, overwrite: bool
) -> None:
    """Convert calibrations of other programs: lenses, and poses where every camera has one.

    \b
      Kalibr       camchain.yaml (pinhole; radtan, equidistant)
      ROS          camera_info YAML, or a folder of them (plumb_bob, rational_polynomial, equidistant)
      OpenCV       YAML, XML or JSON with camera matrices; R and T of stereoCalibrate
      COLMAP       the folder of a model, text or binary
      mrcal        .cameramodel (OPENCV4, 5, 8, 12)
      nerfstudio   transforms.json
      Open3D       trajectory or intrinsics, .json
      RealSense    .json with intrinsics (fx, ppx, ...), Brown Conrady and its inverse
      Azure        calibration .json of Azure Kinect and Femto, with --size of the colour image
      caliscope    camera_array.toml, and Anipose's calibration.toml
      iai_kinect2  folder with calib_color.yaml, calib_ir.yaml, calib_pose.yaml

    A file without poses gives intrinsics, a start for `calibrate --intrinsics`; one with poses gives a rig for `verify`,
    `evaluate` and `fuse`. NAME names the one camera of a file.

    \b
    Examples:
      rgbd-calib import-calibration camchain.yaml -o rig.yaml
      rgbd-calib import-calibration C1=left.yaml C2=right.yaml -o intrinsics.yaml
      rgbd-calib import-calibration calib.xml --size 640x480 -o one.yaml
    """
    from rgbd_calib.cli.import_ import named_files

    given = named_files(files)
    refuse_existing(output, overwrite, inputs=[path for _, path in given])
    from rgbd_calib.pipeline.import_calibration import read_calibrations, write_calibration

    names = dict(_pair(text) for text in rename)
    found = read_calibrations(given, names, None if size is None else _size(size), UNITS_M[unit])
    write_calibration(output, found)
    for note in found.notes:
        say(f"Note: {note}")
    for name, camera in found.cameras.items():
        own = camera.intrinsics
        lens = "no lens" if own is None else f"{own.width}x{own.height} px, {own.model} {len(own.distortion)}"
        parts = [lens, *(["pose"] if found.is_rig else []), *(["depth camera"] if camera.depth is not None else [])]
        say(f"{name}: {', '.join(parts)} (from {found.origins[name]})")
    give(
        {
            "output": str(output),
            "is_rig": found.is_rig,
            "cameras": {
                name: {
                    "from": found.origins[name],
                    "intrinsics": None if camera.intrinsics is None else asdict(camera.intrinsics),
                    "depth_camera": camera.depth is not None,
                }
                for name, camera in found.cameras.items()
            },
            "notes": list(found.notes),
        }
    )
    say(f"Wrote {output}: {'a rig' if found.is_rig else 'intrinsics'} of {len(found.cameras)} cameras")


def _pair(text: str) -> tuple[str, str]:
    old, equals, new = text.partition("=")
    if not (old and equals and new):
        raise ConfigError(f"--rename {text}: OLD=NEW needed")
    return old, new


def _size(text: str) -> tuple[int, int]:
    width, x, height = text.lower().partition("x")
    if not (x and width.isdigit() and height.isdigit()):
        raise ConfigError(f"--size {text}: WIDTHxHEIGHT in pixels needed, such as 640x480")
    return int(width), int(height)

"""`rgbd-calib import`: recordings of other programs."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rgbd_calib.cli.options import (
    Number,
    board_options,
    give,
    json_option,
    output_option,
    overwrite_option,
    progress,
    redist_option,
    refuse_existing,
    say,
)
from rgbd_calib.errors import ConfigError

if TYPE_CHECKING:
    from rgbd_calib.types import Board


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="[ID=]FILE...")
@output_option("the recording, a folder")
@board_options
@click.option(
    "--depth-scale",
    type=Number(1e-6, 1),
    metavar="M",
    help="Metres for each unit of depth.  [default: as FILE says, or by the board]",
)
@click.option(
    "--registered/--unregistered",
    default=None,
    help="Depth lies on its colour image, or has a geometry of its own.  [default: as FILE says, or registered where it has "
    "colour's size]",
)
@click.option("--topics", multiple=True, metavar="ID=COLOR[,DEPTH[,IR]]", help="Of a bag: topics of a camera (repeat).")
@click.option("--color", metavar="PATTERN", help="Of a folder: where colour images are, with {camera}, {frame} and *.")
@click.option("--depth", metavar="PATTERN", help="Where depth images are.")
@click.option("--ir", metavar="PATTERN", help="Where infrared images are.")
@click.option(
    "--match",
    type=click.Choice(["auto", "stem", "timestamp", "order"]),
    default="auto",
    show_default=True,
    help="What makes images of several cameras one instant.",
)
@click.option(
    "--synchronous", is_flag=True, help="The clocks of all FILEs started together: equal times are one instant."
)
@click.option("--color-only", is_flag=True, help="Leave depth and infrared out.")
@click.option("--yes", is_flag=True, help="Ask nothing.")
@redist_option
@json_option
@overwrite_option
def command(
    files: tuple[str, ...],
    output: Path,
    board: Callable[[], Board | None],
    depth_scale: float | None,
    registered: bool | None,
    topics: tuple[str, ...],
    color: str | None,
    depth: str | None,
    ir: str | None,
    match: Any,
    synchronous: bool,
    color_only: bool,
    yes: bool,
    redist: Path | None,
    overwrite: bool,
) -> None:
    """Convert recordings to this program's format: every frame of colour, depth and infrared.

    \b
      .bag .db3 .mcap  ROS 1 and 2, RealSense (librealsense), Orbbec SDK; the folder of a ROS 2 bag
      .mkv             Azure Kinect, Orbbec Femto: one camera each
      .oni             OpenNI: one camera each
      folder           TUM (rgb.txt), BOP, iai_kinect2, libfreenect2 dumps, caliscope, videos with depth images, a
                       recording of this program, or any images whose names tell cameras and frames
      .mp4 .avi ...    a video: one camera, colour

    ID names the camera of a FILE that has one; otherwise they are C1, C2, ..., or as FILE names them. Whatever is not used
    is named. The unit of depth is never assumed: where FILE does not say it, it is concluded from the board, asked for on
    a terminal, or given by --depth-scale. An interrupted import is resumed by the same command.

    \b
    Examples:
      rgbd-calib import left.oni right.oni --synchronous -o recording
      rgbd-calib import rig.mcap -o recording --board 9x6 --square 0.06
      rgbd-calib import scans -o recording --depth-scale 0.001 --match order
    """
    found = named_files(files)
    refuse_existing(output, overwrite, folder=True, inputs=[path for _, path in found])
    from rgbd_calib.io.foreign.ros_topics import parse_topics
    from rgbd_calib.pipeline.import_cameras import CameraOptions
    from rgbd_calib.pipeline.import_recording import ImportOptions, import_recording, nobody
    from rgbd_calib.pipeline.import_sources import OpenOptions, open_source

    patterns: dict[Any, str] = {k: text for k, text in (("color", color), ("depth", depth), ("ir", ir)) if text}
    named = [(name or f"C{i}", path) for i, (name, path) in enumerate(found, 1)]
    named_board = board()
    opening = OpenOptions(parse_topics(topics), patterns, redist, color_only)
    sources = [open_source(path, camera, opening) for camera, path in named]
    for remark in (remark for source in sources for remark in source.remarks):
        say(f"Warning: {remark}")
    if named_board is None:
        named_board = next((source.board for source in sources if source.board is not None), None)
    asking = not yes and sys.stdin.isatty() and sys.stderr.isatty()
    options = ImportOptions(
        CameraOptions(named_board, depth_scale, registered), match, synchronous, color_only, overwrite
    )
    result = import_recording(sources, output, options, _ask if asking else nobody, progress)
    for remark in result.remarks:
        say(remark)
    for camera, counts in result.counts.items():
        infrared = f", {counts['ir']} infrared" if counts["ir"] else ""
        say(f"{camera}: {counts['color']} colour and {counts['depth']} depth frames{infrared}")
    for camera, n in result.left_out.items():
        say(f"Warning: {camera}: {n} depth frames left out: no colour frame of the same instant")
    if result.resumed:
        say(f"{result.resumed} images were there from an earlier import")
    say(f"{output}: {result.frames} frames")
    give(
        {
            "recording": str(output),
            "frames": result.frames,
            "images": result.counts,
            "depth_left_out": result.left_out,
            "resumed": result.resumed,
            "remarks": [remark for source in sources for remark in source.remarks] + list(result.remarks),
        }
    )


def _ask(question: str) -> float | None:
    answer: float = click.prompt(question, default=0.001, type=Number(1e-6, 1), err=True)
    return answer


def named_files(files: tuple[str, ...]) -> list[tuple[str | None, Path]]:
    """(name or None, path) of each [NAME=]FILE.

    Raises
    ------
    ConfigError
        No such file or folder.
    """
    from rgbd_calib.io.reading import check_regular

    named: list[tuple[str | None, Path]] = []
    for text in files:
        name, equals, file = text.partition("=")
        path = Path(file) if equals and not Path(text).exists() else Path(text)
        if not path.exists():
            raise ConfigError(f"{path}: no such file or folder")
        if not path.is_dir():
            check_regular(path, path.stat())
        named.append((name if path != Path(text) else None, path))
    return named

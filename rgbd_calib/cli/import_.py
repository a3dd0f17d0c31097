"""`rgbd-calib import`: recordings of other programs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rgbd_calib.cli.options import (
    board_options,
    output_option,
    overwrite_option,
    redist_option,
    refuse_existing,
    say,
)
from rgbd_calib.errors import ConfigError

if TYPE_CHECKING:
    from rgbd_calib.io.foreign.source import Source
    from rgbd_calib.types import Board


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="[ID=]FILE...")
@output_option("the recording, a folder")
@board_options
@click.option("--topics", multiple=True, metavar="ID=COLOR,DEPTH", help="Of a bag: the topics of a camera (repeat).")
@click.option(
    "--synchronous", is_flag=True, help="The files' clocks started together: frames of the same time are one instant."
)
@click.option("--color-only", is_flag=True, help="Leave depth out, for example because it is not registered to colour.")
@redist_option
@overwrite_option
def command(
    files: tuple[str, ...],
    output: Path,
    board: Callable[[], Board | None],
    topics: tuple[str, ...],
    synchronous: bool,
    color_only: bool,
    redist: Path | None,
    overwrite: bool,
) -> None:
    """Convert recordings to this program's format: every frame, colour and depth paired by time.

    FILE is an OpenNI recording (.oni, one camera each), a ROS 1 or ROS 2 bag or MCAP file (any number of cameras), or a
    TUM RGB-D folder (with rgb.txt and depth.txt). ID names the camera; otherwise they are C1, C2, ..., and those of a
    bag have the names of its topics.

    \b
      rgbd-calib import left.oni right.oni --synchronous -o recording
      rgbd-calib import rig.mcap -o recording --board 9x6 --square 0.06
    """
    named = _named(files)
    refuse_existing(output, overwrite, folder=True, inputs=[path for _, path in named])
    from rgbd_calib.pipeline.import_recording import import_recording

    named_board = board()
    sources = [_source(camera, path, topics, redist) for camera, path in named]
    for remark in (remark for source in sources for remark in source.remarks):
        if not color_only or "registered" not in remark:
            say(f"Warning: {remark}")
    result = import_recording(
        sources, output, board=named_board, synchronous=synchronous, color_only=color_only, overwrite=overwrite
    )
    for camera in result.color:
        say(f"{camera}: {result.color[camera]} colour and {result.depth[camera]} depth frames")
    for camera, n in result.left_out.items():
        say(f"Warning: {camera}: {n} depth frames left out: no colour frame within half a period of them")
    say(f"{output}: {result.frames} frames")


def _named(files: tuple[str, ...]) -> list[tuple[str, Path]]:
    """(camera, path) of each FILE."""
    from rgbd_calib.io.reading import check_regular

    named = []
    for i, text in enumerate(files, 1):
        camera, equals, file = text.partition("=")
        path = Path(file) if equals and not Path(text).exists() else Path(text)
        if not path.exists():
            raise ConfigError(f"{path}: no such file or folder")
        if not path.is_dir():
            check_regular(path, path.stat())
        named.append((camera if path != Path(text) else f"C{i}", path))
    return named


def _source(camera: str, path: Path, topics: tuple[str, ...], redist: Path | None) -> Source:
    from rgbd_calib.io.foreign.ros import RosBag, is_bag, parse_topics
    from rgbd_calib.io.foreign.tum import TumFolder, is_tum
    from rgbd_calib.sensors.oni_file import OniFile

    if path.suffix == ".oni":
        return OniFile(path, camera, redist)
    if is_bag(path):
        return RosBag(path, parse_topics(topics))
    if is_tum(path):
        return TumFolder(path, camera)
    raise ConfigError(
        f"{path}: not a recording that can be imported; .oni, .bag, .mcap, a ROS 2 bag's folder or a TUM folder needed"
    )

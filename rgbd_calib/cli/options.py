"""Options and habits that several commands share."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from rgbd_calib.cli.streams import give as give
from rgbd_calib.cli.streams import json_option as json_option
from rgbd_calib.cli.streams import say as say
from rgbd_calib.cli.streams import show as show
from rgbd_calib.errors import ConfigError

if TYPE_CHECKING:
    from rgbd_calib.types import Board

T = TypeVar("T")
Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


class Output(click.Path):
    """A path that the command writes; every other path among its options and arguments is an input."""


OUTPUT = Output(path_type=Path)


class Number(click.FloatRange):
    """A finite number: no limit in the range holds for nan, and no error exceeds inf."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


recording_argument = click.argument("recording", type=click.Path(path_type=Path))
overwrite_option = click.option(
    "--overwrite",
    is_flag=True,
    help="Replace the output if it exists: a file, or a folder that rgbd-calib wrote. Other files in it are kept.",
)
within_range_option = click.option(
    "--within-range", is_flag=True, help="Leave out depth outside the range of the data of the rig's depth bias."
)
seed_option = click.option("--seed", type=int, default=0, show_default=True, help="Seed of every random choice.")
jobs_option = click.option(
    "--jobs", type=click.IntRange(1), default=None, help="Processes to use.  [default: as many as there are cores]"
)


def workers_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """--jobs, --dask and --no-cache, given to the command as `workers`."""

    @jobs_option
    @click.option(
        "--dask",
        metavar="ADDRESS",
        help="Scheduler of a Dask cluster to look at the images, such as tcp://10.0.0.1:8786; it and its workers need "
        "this version of rgbd-calib, the workers also RECORDING under the same path.",
    )
    @click.option(
        "--no-cache", is_flag=True, help="Ignore the detection cache, and write nothing to it (see rgbd-calib cache)."
    )
    @wraps(command)
    def with_workers(*args: Any, jobs: int | None, dask: str | None, no_cache: bool, **options: Any) -> Any:
        if jobs is not None and dask is not None:
            raise click.UsageError("--jobs goes without --dask: the cluster determines the number of workers")
        from rgbd_calib.io.cache import default_folder
        from rgbd_calib.pipeline.workers import Workers

        workers = Workers(jobs, dask, None if no_cache else default_folder(), say)
        return command(*args, workers=workers, **options)

    return with_workers


redist_option = click.option(
    "--redist",
    type=click.Path(path_type=Path),
    help="Folder of the OpenNI2 runtime.  [default: OPENNI2_REDIST64, then the system's]",
)


driver_option = click.option(
    "--driver",
    "drivers",
    multiple=True,
    metavar="NAME",
    help="openni2, realsense, azure, orbbec, or replay:RECORDING, a recording played as cameras (repeat).  [default: all that are installed]",
)


def board_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """--board COLSxROWS --square M [--two-sided M], or --board FILE; given to the command as `board`: call it for a Board or
    None."""

    @click.option(
        "--board",
        "board_size",
        metavar="COLSxROWS|FILE",
        help="Inner corners of the checkerboard, such as 9x6; or a YAML file with the board: dataset.yaml, the output of "
        "`rgbd-calib board`, Kalibr's target.yaml.",
    )
    @click.option("--square", type=Number(), metavar="M", help="Side of its squares, metres.")
    @click.option(
        "--two-sided", type=Number(), metavar="M", help="The print is on both faces of a board this thick, metres."
    )
    @wraps(command)
    def with_board(
        *args: Any, board_size: str | None, square: float | None, two_sided: float | None, **options: Any
    ) -> Any:
        return command(*args, board=lambda: parse_board(board_size, square, two_sided), **options)

    return with_board


def pattern_options(name: str, what: str) -> Decorator:
    """`name` as kind, --marker as marker_m, and --dictionary: what is printed on a board."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        for option in (
            click.option(
                "--dictionary", help="Of the markers, as OpenCV names it.  [default: DICT_5X5_250, DICT_APRILTAG_36h11]"
            ),
            click.option(
                "--marker",
                "marker_m",
                type=Number(),
                help="Side of a marker, metres.  [default: 0.75 squares; AprilGrid: squares / 0.65]",
            ),
            click.option(
                name,
                "kind",
                type=click.Choice(["checkerboard", "charuco", "aprilgrid"]),
                default="checkerboard",
                show_default=True,
                help=what,
            ),
        ):
            function = option(function)
        return function

    return decorate


def parse_board(size: str | None, square_m: float | None, thickness_m: float | None) -> Board | None:
    """The board of the options, or None where none was given."""
    from rgbd_calib.types import Board

    if size is None and square_m is None and thickness_m is None:
        return None
    if size is not None and size.lower().endswith((".yaml", ".yml")):
        from rgbd_calib.io.board_files import read_board

        if square_m is not None or thickness_m is not None:
            raise ConfigError(f"--board {size}: the file describes the whole board. Leave out --square and --two-sided")
        return read_board(Path(size))
    cols, x, rows = (size or "").lower().partition("x")
    if not (x and cols.isdigit() and rows.isdigit() and min(int(cols), int(rows)) >= 2):
        raise ConfigError(
            f"--board {size}: COLSxROWS of inner corners needed, such as 9x6, or a .yaml file with the board"
        )
    if square_m is None:
        raise ConfigError(
            f"--board {size}: --square M expected beside it: the side of a square as measured, metres. Add it"
        )
    if not 0.001 <= square_m <= 1:
        raise ConfigError(f"--square {square_m:g}: the side of a square in metres needed, such as 0.06")
    if thickness_m is not None and not 0 <= thickness_m <= 0.1:
        raise ConfigError(f"--two-sided {thickness_m}: the board's thickness in metres needed, such as 0.006")
    return Board(int(cols), int(rows), square_m, thickness_m is not None, thickness_m or 0.0)


config_option = click.option(
    "--config", type=click.Path(path_type=Path), help="YAML with settings; the command line wins over it."
)
lens_option = click.option(
    "--lens",
    type=click.Choice(["auto", "brown", "rational", "fisheye"]),
    help="Lens model to estimate: OpenCV's 5 coefficients, its 8, or its fisheye; auto: what views held out ask for. Of given "
    "intrinsics, and of few views, it stays what it is.  [default: auto]",
)
corners_option = click.option(
    "--corners", type=click.Path(path_type=Path), help="corners.csv of `rgbd-calib detect`, instead of detecting again."
)


def method_options(methods: tuple[str, ...]) -> Decorator:
    """--method, --sigma-2d, --sigma-3d, --reference and --seed, for the commands that estimate poses."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        positive = Number(0, min_open=True)
        for option in (
            click.option("--seed", type=int, default=None, help="Seed of every random choice.  [default: 0]"),
            click.option("--reference", help="Camera whose frame is the world.  [default: the first]"),
            click.option("--sigma-3d", type=positive, help="Known noise of a 3D coordinate, m (not with bundle)."),
            click.option("--sigma-2d", type=positive, help="Known noise of a pixel coordinate, px (not with bundle)."),
            click.option("--method", type=click.Choice(methods), help=f"Estimator.  [default: {methods[-1]}]"),
        ):
            function = option(function)
        return function

    return decorate


def output_option(what: str, required: bool = True) -> Decorator:
    """-o/--output FILE, described by `what`."""
    return click.option("-o", "--output", type=OUTPUT, required=required, help=f"Where to write {what}.")


def refuse_existing(path: Path, overwrite: bool, *, folder: bool = False, inputs: Iterable[Path] = ()) -> None:
    """Stop before any work where the result would replace something, or could not be written.

    Parameters
    ----------
    overwrite
        A regular file, or a folder that an earlier run wrote, may be replaced; never one of the command's inputs.
    folder
        The result is a folder, written whole.
    inputs
        What the command reads beside the paths among its own options and arguments.

    Raises
    ------
    ConfigError
        Says what is in the way.
    """
    from rgbd_calib.io.conflicts import refuse_input, refuse_inside
    from rgbd_calib.io.files import check_output, resolved
    from rgbd_calib.io.folders import check_replaceable, foreign_names

    target = resolved(path)
    _refuse_twice(path, target)
    if folder:
        refuse_inside(path, (*_inputs(), *inputs))
    else:
        check_output(path)
    if os.path.lexists(target):
        refuse_input(path, (*_inputs(), *inputs))
        if not overwrite:
            raise ConfigError(f"{path}: exists already. Choose another name, or replace it with --overwrite")
        if folder:
            check_replaceable(target)
            if kept := foreign_names(target):
                say(
                    f"{path}: files not written by rgbd-calib are kept: {', '.join(kept[:3])}{', ...' if kept[3:] else ''}"
                )
        elif not os.access(target, os.W_OK):
            raise ConfigError(f"{path}: cannot be written (write-protected). Choose another name")
    above = next(p for p in target.absolute().parents if os.path.lexists(p))
    if not above.is_dir():
        raise ConfigError(f"{path}: cannot be written ({above} is a file). Move it, or choose another name")
    if not os.access(above, os.W_OK):
        raise ConfigError(f"{path}: cannot be written ({above} is read-only). Choose a folder you may write to")


def _inputs() -> list[Path]:
    """The paths among the options and arguments of the command that are not outputs."""
    context = click.get_current_context()
    outputs = {p.name for p in context.command.params if isinstance(p.type, Output)}
    return [value for name, value in context.params.items() if isinstance(value, Path) and name not in outputs]


def _refuse_twice(path: Path, target: Path) -> None:
    """Two outputs of one command must not be one file, on disks that know no case either."""
    seen: dict[str, Path] = click.get_current_context().meta.setdefault(f"{__name__}.outputs", {})
    key = os.path.normpath(target.absolute()).casefold()
    if key in seen:
        raise ConfigError(f"{path}: is also the output {seen[key]}. Give each output a different name")
    seen[key] = path


def progress(items: Iterable[T], total: int, what: str) -> Iterator[T]:
    """The items, with a progress bar on stderr (none where stderr is not a terminal)."""
    from rgbd_calib.pipeline.progress import bar

    yield from bar(items, total, what)

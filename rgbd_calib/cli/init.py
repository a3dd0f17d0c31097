"""`rgbd-calib init`: a dataset.yaml for a folder of images."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rgbd_calib.cli.options import Number, board_options, give, json_option, overwrite_option, progress, say, show
from rgbd_calib.errors import ConfigError

if TYPE_CHECKING:
    from rgbd_calib.pipeline.init_recording import FolderContents
    from rgbd_calib.types import Board
    from rgbd_calib.views.board_guess import BoardGuess


@click.command
@click.argument("folder", type=click.Path(path_type=Path))
@board_options
@click.option("--depth-scale", type=Number(1e-6, 1), metavar="M", help="Metres for each unit of depth, such as 0.001.")
@click.option(
    "--registered/--unregistered",
    default=None,
    help="Depth lies on its colour image, or has a geometry of its own.  [default: registered where it has colour's size]",
)
@click.option("--color", metavar="PATTERN", help="Where colour images are, with {camera}, {frame} and * in it.")
@click.option("--depth", metavar="PATTERN", help="Where depth images are.")
@click.option("--ir", metavar="PATTERN", help="Where infrared images are.")
@click.option("--calibration", type=click.Path(path_type=Path), help="Lenses of the cameras (see import-calibration).")
@click.option("--yes", is_flag=True, help="Ask nothing.")
@click.option("--dry-run", is_flag=True, help="Print dataset.yaml, write nothing.")
@json_option
@overwrite_option
def command(
    folder: Path,
    board: Callable[[], Board | None],
    depth_scale: float | None,
    registered: bool | None,
    color: str | None,
    depth: str | None,
    ir: str | None,
    calibration: Path | None,
    yes: bool,
    dry_run: bool,
    overwrite: bool,
) -> None:
    """Look at FOLDER and write its dataset.yaml, so that its images are read where they are.

    Finds cameras, colour, depth and infrared images by names and types, frames that belong together, calibration files, and
    the inner corners of a checkerboard. Nothing is moved or copied. On a terminal it asks for what images do not tell: the
    side of a square, the thickness of a two-sided board, and the unit of depth where the board does not decide. It asks
    nothing with --yes, or where it is not run on a terminal.

    \b
    Examples:
      rgbd-calib init photos --board 9x6 --square 0.06
      rgbd-calib init scans --board 9x6 --square 0.06 --yes          # asks nothing
      rgbd-calib init mixed --color "rgb_{camera}_{frame}.jpg" --depth "{camera}/depth_{frame}.tiff" --dry-run
    """
    target = folder / "dataset.yaml"
    if target.exists() and not overwrite and not dry_run:
        raise ConfigError(f"{target}: exists already. Correct it by hand, or replace it with --overwrite")
    from rgbd_calib.io.dataset import dataset_data
    from rgbd_calib.io.files import dump_yaml, write_text
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.pipeline.config import load_config
    from rgbd_calib.pipeline.init_recording import Answers, check_frames, describe, find_board, look_at, sentences

    named_board = board()
    given: dict[Any, str] = {k: text for k, text in (("color", color), ("depth", depth), ("ir", ir)) if text}
    found = look_at(folder, given, calibration)
    for line in sentences(found):
        say(line)
    check_frames(found)
    asking = not yes and sys.stdin.isatty() and sys.stderr.isatty()
    if named_board is None and len(found.boards) == 1:
        ((path, named_board),) = found.boards
        say(f"{path}: the board")
    if named_board is None:
        named_board = _board(find_board(found, progress), asking)
    answers = Answers(named_board, depth_scale, _registered(found, registered, asking))
    told = describe(found, answers, load_config(None), progress)
    if told.unknown_unit and named_board is not None and named_board.type == "checkerboard":
        _check_board(folder, named_board, find_board(found, progress))
    if told.unknown_unit:
        answers = replace(answers, depth_scale=_unit(folder, told.unknown_unit, asking))
        told = describe(found, answers, load_config(None), progress)
    for remark in told.remarks:
        say(remark)
    files = None if found.guess.is_standard(folder) else found.guess.patterns
    text = dump_yaml(dataset_data(told.cameras, named_board, None, files))
    if dry_run:
        show(text.rstrip("\n"))
        return
    before = target.read_text("utf-8") if target.exists() else None
    write_text(target, text)
    try:
        remarks = open_recording(folder).remarks
    except ConfigError:  # a description that does not hold stays away: the next command would find it
        target.unlink() if before is None else write_text(target, before)
        raise
    for remark in remarks:
        say(f"Warning: {remark}")
    say(f"Wrote {target}. Next: rgbd-calib doctor {folder}")
    give(
        {
            "dataset": str(target),
            "images": {
                name: {kind: len(own[name].files) for kind, own in found.guess.streams.items() if name in own}
                for name in found.guess.cameras
            },
            "frames_together": found.together,
            "remarks": [*found.guess.remarks, *told.remarks, *remarks],
        }
    )


def _board(guess: BoardGuess | None, asking: bool) -> Board | None:
    """The board, asked for on a terminal; None where it is not known whole."""
    from rgbd_calib.cli.options import parse_board

    if guess is not None:
        say(f"Board: {guess.cols}x{guess.rows} inner corners in {guess.images} of {guess.looked_at} images")
    if not asking:
        size = f"{guess.cols}x{guess.rows}" if guess else "COLSxROWS"
        say(f"No board is written: its squares are not known. Give --board {size} --square M")
        return None
    default = f"{guess.cols}x{guess.rows}" if guess else ""
    size = _ask("Board, inner corners COLSxROWS (nothing: none)", default)
    if not size:
        return None
    square = _ask("Side of its squares, metres, as measured", "")
    if not square:
        say("No board is written: its squares are not known")
        return None
    thickness = _ask("Printed on both faces: thickness, metres (nothing: one face)", "")
    return parse_board(size, _number(square, "square"), _number(thickness, "thickness") if thickness else None)


def _check_board(folder: Path, board: Board, guess: BoardGuess | None) -> None:
    """Raise ConfigError where images show another board than the one given."""
    if guess is not None and {guess.cols, guess.rows} != {board.cols, board.rows}:
        raise ConfigError(
            f"{folder}: --board {board.cols}x{board.rows} expected in the images, {guess.cols}x{guess.rows} inner corners seen in "
            f"{guess.images} of {guess.looked_at} images. Give --board {guess.cols}x{guess.rows}"
        )


def _registered(found: FolderContents, registered: bool | None, asking: bool) -> bool | None:
    """Whether depth lies on colour; asked on a terminal where sizes do not tell."""
    color, depth = found.guess.streams["color"], found.guess.streams["depth"]
    if registered is not None or not depth:
        return registered
    same = all(
        (s.sniffed.width, s.sniffed.height) == (color[c].sniffed.width, color[c].sniffed.height)
        for c, s in depth.items()
    )
    if asking:
        answer = _ask("Does depth lie on its colour image (registered, aligned)? y/n", "y" if same else "n")
        return answer.lower().startswith("y")
    if same:
        say("Depth has the size of colour and is taken as registered to it (--unregistered if it is not)")
    else:
        say("Depth has another size than colour and is taken as not registered (--registered if it is)")
    return None


def _unit(folder: Path, unknown: dict[str, str], asking: bool) -> float:
    """Metres for each unit of depth, asked for on a terminal.

    Raises
    ------
    ConfigError
        Nobody can be asked.
    """
    if asking:
        for why in unknown.values():
            say(why)
        return _number(_ask(f"{', '.join(unknown)}: metres for each unit of depth", "0.001"), "depth scale")
    if apart := next((why for why in unknown.values() if "does not follow" in why), None):
        raise ConfigError(f"{folder}: {apart}")
    raise ConfigError(
        f"{folder}: the unit of the depth images of {', '.join(unknown)} is not known ({next(iter(unknown.values()))}). Give "
        "--depth-scale (0.001 for millimetres, 0.0002 for TUM's 5000 a metre), or --board and --square as measured"
    )


def _ask(question: str, default: str) -> str:
    answer: str = click.prompt(question, default=default, show_default=bool(default), err=True)
    return answer.strip()


def _number(text: str, what: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ConfigError(f"{what}: a number of metres expected, {text[:40]!r} found. Type it as in 0.06")
    return number

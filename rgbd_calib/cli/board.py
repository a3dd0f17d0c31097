"""`rgbd-calib board`: a calibration board for the printer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rgbd_calib.cli.options import Number, output_option, overwrite_option, pattern_options, refuse_existing, say, show
from rgbd_calib.errors import ConfigError

if TYPE_CHECKING:
    from rgbd_calib.types import BoardType


@click.command
@click.option("--cols", type=click.IntRange(2, 200), default=9, show_default=True, help="Inner corners in a row.")
@click.option("--rows", type=click.IntRange(2, 200), default=6, show_default=True, help="Inner corners in a column.")
@click.option("--square", "square_m", type=Number(0, min_open=True), required=True, help="Side of a square, metres.")
@pattern_options("--type", "Pattern.")
@click.option("--two-sided", is_flag=True, help="A second page for the back.")
@click.option(
    "--thickness",
    "thickness_m",
    type=Number(0),
    default=0.0,
    help="Of a two-sided board, metres, for the numbers printed on it.",
)
@click.option(
    "--page", default="auto", show_default=True, help="A4 to A0, WIDTHxHEIGHT in mm, or the smallest that fits."
)
@click.option(
    "--tile", metavar="PAGE", help="Over several pages of this size, such as A4, with marks to cut and join (.pdf)."
)
@click.option(
    "--measured",
    metavar="WIDTHxHEIGHT",
    help="Size of a first print between its outermost corners, mm, such as 179.4x119.8: drawn again so that it prints true.",
)
@output_option("the board, .pdf or .svg")
@overwrite_option
def command(
    cols: int,
    rows: int,
    square_m: float,
    kind: BoardType,
    marker_m: float | None,
    dictionary: str | None,
    two_sided: bool,
    thickness_m: float,
    page: str,
    tile: str | None,
    measured: str | None,
    output: Path,
    overwrite: bool,
) -> None:
    """Draw a calibration board for the printer.

    At true scale, with a ruler; its line of dataset.yaml goes to stdout and onto the page. The back of a two-sided board carries the same print; glued back to back, both upright, its corners coincide with
    the front's. Choose cols + rows odd, so that a checkerboard cannot be mistaken for itself turned by half.

    \b
    Examples:
      rgbd-calib board --square 0.022 -o board.pdf                       # fits A4, for close views
      rgbd-calib board --cols 8 --rows 5 --square 0.08 --two-sided --thickness 0.006 -o opposed.pdf
      rgbd-calib board --type charuco --square 0.04 --marker 0.03 -o charuco.svg
      rgbd-calib board --type aprilgrid --cols 12 --rows 8 --square 0.0195 -o tags.pdf   # 6 x 4 tags of 30 mm
      rgbd-calib board --square 0.06 --tile A4 -o tiles.pdf              # over several sheets of A4
      rgbd-calib board --square 0.02 --measured 159.4x99.8 -o again.pdf  # the first print came out too small
    """
    if output.suffix.lower() not in (".pdf", ".svg"):
        raise ConfigError(f"{output}: a name that ends in .pdf or .svg is needed. Try {output.with_suffix('.pdf')}")
    if square_m >= 1:
        raise ConfigError(
            f"--square: {square_m:g} metres seen. Did you mean {square_m / 1000:g} (millimetres are not metres)?"
        )

    from rgbd_calib.io.drawings import write_pdf, write_svg
    from rgbd_calib.patterns import of_type
    from rgbd_calib.report import board_sheet, board_tiles
    from rgbd_calib.types import Board

    board = Board(cols, rows, square_m, two_sided, thickness_m if two_sided else 0.0)
    board = of_type(board, kind, marker_m, dictionary)
    if tile is not None:
        if page != "auto" or output.suffix.lower() != ".pdf":
            raise ConfigError(
                "--tile: a .pdf over pages of one size is needed. Leave out --page, and name the output .pdf"
            )
        sheets = board_tiles.tiles(board, tile)
        pages = f"{len(sheets)} pages {tile.upper()}"
    else:
        size = board_sheet.page_mm(board, page)
        sheets = board_sheet.sheets(board, size)
        pages = f"{size[0]:g} x {size[1]:g} mm"
    if measured is not None:
        factors = board_tiles.scale_of(board, measured)
        sheets = tuple(board_tiles.scaled(sheet, factors) for sheet in sheets)
        pages += f", scaled by {factors[0]:.4f} along the columns and {factors[1]:.4f} along the rows"
    title = board_sheet.title(board)
    if output.suffix.lower() == ".pdf":
        targets = [output]
    else:
        targets = [output, *([output.with_suffix(".back.svg")] if two_sided else [])]
    for path in targets:
        refuse_existing(path, overwrite)
    if output.suffix.lower() == ".pdf":
        write_pdf(output, sheets, title)
    else:
        for path, sheet in zip(targets, sheets, strict=True):
            write_svg(path, sheet, title)
    show(board_sheet.numbers(board))
    say(f"{' and '.join(map(str, targets))}: {pages}. Print at 100 %, then measure the squares")
    if two_sided and thickness_m == 0:
        say("Measure the finished board's thickness and correct it in dataset.yaml")
    if board.symmetric:
        say(f"cols + rows is even ({cols} + {rows}): half a turn of this board cannot be seen. An odd sum is better")

"""`rgbd-calib board`: a calibration board for the printer."""

from __future__ import annotations

from pathlib import Path

import click

from rgbd_calib.cli.options import output_option, overwrite_option, refuse_existing, say, show
from rgbd_calib.errors import ConfigError


@click.command
@click.option("--cols", type=click.IntRange(2, 200), default=9, show_default=True, help="Inner corners in a row.")
@click.option("--rows", type=click.IntRange(2, 200), default=6, show_default=True, help="Inner corners in a column.")
@click.option(
    "--square", "square_m", type=click.FloatRange(0, min_open=True), required=True, help="Side of a square, metres."
)
@click.option(
    "--type", "kind", type=click.Choice(["checkerboard", "charuco"]), default="checkerboard", show_default=True
)
@click.option("--marker", "marker_m", type=float, help="Side of a ChArUco marker, metres.  [default: 0.75 squares]")
@click.option("--dictionary", default="DICT_5X5_250", show_default=True, help="ChArUco dictionary, as OpenCV names it.")
@click.option("--two-sided", is_flag=True, help="A second page for the back.")
@click.option(
    "--thickness",
    "thickness_m",
    type=click.FloatRange(0),
    default=0.0,
    help="Of a two-sided board, metres, for the numbers printed on it.",
)
@click.option(
    "--page", default="auto", show_default=True, help="A4 to A0, WIDTHxHEIGHT in mm, or the smallest that fits."
)
@output_option("the board, .pdf or .svg")
@overwrite_option
def command(
    cols: int,
    rows: int,
    square_m: float,
    kind: str,
    marker_m: float | None,
    dictionary: str,
    two_sided: bool,
    thickness_m: float,
    page: str,
    output: Path,
    overwrite: bool,
) -> None:
    """Draw a calibration board for the printer.

    At true scale, with a ruler; its line of dataset.yaml goes to stdout and onto the page. The back of a two-sided board carries the same print; glued back to back, both upright, its corners coincide with
    the front's. Choose cols + rows odd, so that a checkerboard cannot be mistaken for itself turned by half.

    \b
    Examples:
      rgbd-calib board --square 0.022 -o board.pdf                       # fits A4, for close views
      rgbd-calib board --cols 8 --rows 5 --square 0.08 --two-sided --thickness 0.006 -o board.pdf
      rgbd-calib board --type charuco --square 0.04 --marker 0.03 -o board.svg
    """
    if output.suffix.lower() not in (".pdf", ".svg"):
        raise ConfigError(f"{output}: a name that ends in .pdf or .svg is needed. Try {output.with_suffix('.pdf')}")
    if square_m >= 1:
        raise ConfigError(
            f"--square: {square_m:g} metres seen. Did you mean {square_m / 1000:g} (millimetres are not metres)?"
        )

    from rgbd_calib.io.drawings import write_pdf, write_svg
    from rgbd_calib.report import board_sheet, charuco
    from rgbd_calib.types import Board

    is_charuco = kind == "charuco"
    board = Board(
        cols,
        rows,
        square_m,
        two_sided,
        thickness_m if two_sided else 0.0,
        "charuco" if is_charuco else "checkerboard",
        (round(0.75 * square_m, 4) if marker_m is None else marker_m) if is_charuco else 0.0,
        dictionary if is_charuco else "",
    )
    if is_charuco:
        charuco.check(board)
    size = board_sheet.page_mm(board, page)
    sheets = board_sheet.sheets(board, size)
    title = f"{cols} x {rows} inner corners, squares of {square_m * 1000:g} mm"
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
    say(f"{' and '.join(map(str, targets))}: {size[0]:g} x {size[1]:g} mm. Print at 100 %, then measure the squares")
    if two_sided and thickness_m == 0:
        say("Measure the finished board's thickness and correct it in dataset.yaml")
    if board.symmetric:
        say(f"cols + rows is even ({cols} + {rows}): half a turn of this board cannot be seen. An odd sum is better")

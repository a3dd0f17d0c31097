"""A board over several small pages, to be cut and joined, and a drawing scaled against a printer that does not print true.

Each page shows a rectangle of the board; corner marks outside it give the lines to cut along. To the right and below, the
print continues for a flap, over which the next page is glued, edge on the line that the marks give.
"""

from __future__ import annotations

import math

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.drawings import Fill, Line, Shape, Sheet, Text
from rgbd_calib.report.board_sheet import PAGES_MM, pattern, pattern_mm, rim_mm, ruler, title
from rgbd_calib.types import Board

_EDGE_MM = 10.0
_FLAP_MM = 5.0
_FOOT_MM = 14.0
_MARK_MM = (6.0, 9.0)
"""Where marks begin and end, from the rectangle: beyond the flap, on the page."""
_RULER_MM = 100.0
LARGEST = 0.1
"""Printers are off by a few percent; more is a mistake of whoever measured."""


def tiles(board: Board, page: str) -> tuple[Sheet, ...]:
    """The board over pages of a name as A4, rows of pages from the top, and after those of the front those of the back.

    Raises
    ------
    ConfigError
        No such page.
    """
    if page.upper() not in PAGES_MM:
        raise ConfigError(f"--tile: '{page}' seen; one of {', '.join(PAGES_MM)} needed")
    white = max(board.square_m * 500, _EDGE_MM)
    width, height = (side + 2 * white for side in pattern_mm(board))
    upright = PAGES_MM[page.upper()]
    layouts = [(_counts(size, width, height), size) for size in (upright, upright[::-1])]
    (nx, ny), size = min(layouts, key=lambda layout: math.prod(layout[0]))
    at = white + rim_mm(board)
    whole = pattern(board, at, at)
    return tuple(
        _tile(board, whole, size, (i * width / nx, j * height / ny, width / nx, height / ny), (i, j, nx, ny), face)
        for face in ((" front", " back") if board.two_sided else ("",))
        for j in range(ny)
        for i in range(nx)
    )


def scale_of(board: Board, measured: str) -> tuple[float, float]:
    """Factors along columns and rows that make the next print true, of WIDTHxHEIGHT in mm as measured on this one.

    Raises
    ------
    ConfigError
        Not two numbers, or other distances than between the outer corners.
    """
    width, height = board.grid[-1] * board.square_m * 1000
    try:
        w, h = (float(part) for part in measured.lower().split("x"))
    except ValueError:
        w = h = math.nan
    if not (abs(w / width - 1) < LARGEST and abs(h / height - 1) < LARGEST):
        raise ConfigError(
            f"--measured {measured}: WIDTHxHEIGHT in mm between the outermost inner corners needed, near {width:g}x{height:g}. "
            "Measure from the first to the last corner along a row and along a column"
        )
    return width / w, height / h


def scaled(sheet: Sheet, factors: tuple[float, float]) -> Sheet:
    """All of a sheet drawn larger or smaller about the middle of the page, which stays."""
    (fx, fy), (mx, my) = factors, (sheet.width / 2, sheet.height / 2)

    def x(value: float) -> float:
        return mx + (value - mx) * fx

    def y(value: float) -> float:
        return my + (value - my) * fy

    def one(shape: Shape) -> Shape:
        if isinstance(shape, Fill):
            return Fill(tuple((x(a), y(b), w * fx, h * fy) for a, b, w, h in shape.rectangles), shape.gray)
        if isinstance(shape, Line):
            return Line(x(shape.x1), y(shape.y1), x(shape.x2), y(shape.y2), shape.width)
        return Text(x(shape.x), y(shape.y), shape.text, shape.size, shape.centered)

    return Sheet(sheet.width, sheet.height, tuple(one(shape) for shape in sheet.shapes))


def _counts(page: tuple[float, float], width: float, height: float) -> tuple[int, int]:
    """Pages side by side and below each other."""
    room = page[0] - 2 * _EDGE_MM, page[1] - 2 * _EDGE_MM - _FOOT_MM
    return math.ceil(width / room[0]), math.ceil(height / room[1])


def _tile(
    board: Board,
    whole: list[Shape],
    page: tuple[float, float],
    window: tuple[float, float, float, float],
    place: tuple[int, int, int, int],
    face: str,
) -> Sheet:
    """The page of one rectangle (x, y, width, height) of the drawing."""
    x, y, width, height = window
    i, j, nx, ny = place
    right, bottom = (_FLAP_MM if i + 1 < nx else 0.0), (_FLAP_MM if j + 1 < ny else 0.0)
    left, top = (page[0] - width) / 2, _EDGE_MM
    shapes: list[Shape] = []
    for fill in whole:
        assert isinstance(fill, Fill)
        parts = [_clipped(part, (x, y, x + width + right, y + height + bottom)) for part in fill.rectangles]
        moved = tuple((a - x + left, b - y + top, w, h) for a, b, w, h in parts if w > 0 and h > 0)
        shapes += [Fill(moved, fill.gray)] if moved else []
    near, far = _MARK_MM
    for at_y in (top, top + height):
        shapes += [Line(left - far, at_y, left - near, at_y), Line(left + width + near, at_y, left + width + far, at_y)]
    for at_x in (left, left + width):
        shapes += [Line(at_x, top - far, at_x, top - near), Line(at_x, top + height + near, at_x, top + height + far)]
    foot = page[1] - _FOOT_MM
    shapes += ruler(left, foot, _RULER_MM)
    lines = [f"rgbd-calib{face}: row {j + 1} of {ny}, column {i + 1} of {nx}. Print at 100 %", title(board)]
    if nx * ny > 1:
        lines.append("Cut left and top along the marks; glue over the flap")
    room = page[0] - 2 * _EDGE_MM - _RULER_MM - 5
    size = min(2.8, room / (0.5 * max(map(len, lines))))
    shapes += [Text(left + _RULER_MM + 5, foot + 1.5 + 3.6 * n, line, size) for n, line in enumerate(lines)]
    return Sheet(*page, tuple(shapes))


def _clipped(
    part: tuple[float, float, float, float], to: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    """What of a rectangle (x, y, width, height) is within (x0, y0, x1, y1); negative sizes where nothing is."""
    x0, y0 = max(part[0], to[0]), max(part[1], to[1])
    return x0, y0, min(part[0] + part[2], to[2]) - x0, min(part[1] + part[3], to[3]) - y0

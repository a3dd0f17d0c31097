"""A calibration board as pages for the printer: pattern, ruler, registration marks and the numbers of dataset.yaml.

Two-sided boards: both faces carry the same print. Glued back to back, the board turned about its vertical axis, a
point x from the left edge of one face lies behind the point (page width - x) of the other. The pattern stands in the
middle of the page, so corner (c, r) of the front lies behind corner (cols - 1 - c, r) of the back, as the formats ask.
Squares that lie behind each other have the same colour where cols is even, opposite ones where it is odd; nothing
depends on it, as long as the board lets no light through.
"""

from __future__ import annotations

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.drawings import Fill, Line, Shape, Sheet, Text
from rgbd_calib.patterns.aprilgrid import gap_m
from rgbd_calib.patterns.black import rectangles_m, rim_m
from rgbd_calib.types import Board

PAGES_MM = {
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
}
"""ISO 216, upright."""

_FOOT_MM = 30.0  # ruler and text below the pattern
_EDGE_MM = 10.0  # what printers leave white, and room for the marks
_MIN_TEXT_WIDTH_MM = 150.0


def needed_mm(board: Board) -> tuple[float, float]:
    """Width and height of the smallest page: the squares, half a square of white around them, the foot."""
    white = max(board.square_m * 500, _EDGE_MM)
    width, height = pattern_mm(board)
    return max(width + 2 * white, _MIN_TEXT_WIDTH_MM), height + white + max(white, _EDGE_MM) + _FOOT_MM


def pattern_mm(board: Board) -> tuple[float, float]:
    """Width and height of what is black on the board."""
    width, height = board.grid[-1] * board.square_m * 1000
    return float(width + 2 * rim_mm(board)), float(height + 2 * rim_mm(board))


def rim_mm(board: Board) -> float:
    """What is black beyond the outer corners: squares, the small ones of an AprilGrid."""
    return 1000 * rim_m(board)


def page_mm(board: Board, page: str) -> tuple[float, float]:
    """Page width and height: `auto` (the smallest ISO page, upright or not), a name as A2, or WIDTHxHEIGHT in mm.

    Raises
    ------
    ConfigError
        Not a page, or too small for the board; says what would fit.
    """
    width, height = needed_mm(board)
    if page == "auto" or page.upper() in PAGES_MM:
        names = PAGES_MM if page == "auto" else (page.upper(),)
        sizes = [size for name in names for size in (PAGES_MM[name], PAGES_MM[name][::-1])]
    else:
        try:
            w, h = (float(part) for part in page.lower().split("x"))
        except ValueError:
            raise ConfigError(
                f"--page: '{page}' seen; auto, {', '.join(PAGES_MM)} or WIDTHxHEIGHT in mm needed"
            ) from None
        sizes = [(w, h)]
    for size in sizes:
        if width <= size[0] and height <= size[1]:
            return size
    raise ConfigError(
        f"--page {page}: the board needs {np.ceil(width):.0f} x {np.ceil(height):.0f} mm, the largest page tried is "
        f"{sizes[-1][0]:g} x {sizes[-1][1]:g} mm. Take a larger page (--page {np.ceil(width):.0f}x{np.ceil(height):.0f}), "
        "fewer corners or smaller squares"
    )


def sheets(board: Board, page: tuple[float, float]) -> tuple[Sheet, ...]:
    """The page of the front, and for a two-sided board that of the back."""
    faces = (" front", " back") if board.two_sided else ("",)
    return tuple(_sheet(board, page, face) for face in faces)


def first_corner_mm(board: Board, page: tuple[float, float]) -> tuple[float, float]:
    """Where inner corner (0, 0) stands on the page, from its top left corner."""
    width, height = pattern_mm(board)
    return (page[0] - width) / 2 + rim_mm(board), (page[1] - _FOOT_MM - height) / 2 + rim_mm(board)


def numbers(board: Board) -> str:
    """The line of dataset.yaml."""
    parts = [f"type: {board.type}", f"cols: {board.cols}", f"rows: {board.rows}", f"square: {board.square_m:.6g}"]
    if board.type != "checkerboard":
        parts += [f"marker: {board.marker_m:.6g}", f"dictionary: {board.dictionary}"]
    if board.two_sided:
        parts += ["two_sided: true", f"thickness: {board.thickness_m:.6g}"]
    return f"board: {{{', '.join(parts)}}}"


def _sheet(board: Board, page: tuple[float, float], face: str) -> Sheet:
    x, y = first_corner_mm(board, page)
    square = board.square_m * 1000
    shapes = pattern(board, x, y)
    x, y = x - rim_mm(board), y - rim_mm(board)
    bottom = y + pattern_mm(board)[1]
    foot = max(bottom + max(square / 2, _EDGE_MM), page[1] - _FOOT_MM)
    left = max(_EDGE_MM, min(x, (page[0] - _MIN_TEXT_WIDTH_MM) / 2))
    shapes += _marks(page, y, bottom)
    shapes += ruler(left, foot + 2, page[0] - 2 * left)
    text = [
        f"rgbd-calib{face}: {title(board)}. Print at 100 %, not fitted to the page;",
        "measure the ruler and several squares, and write what you measured into dataset.yaml:",
        numbers(board),
    ]
    if board.two_sided:
        text[1] = (
            "measure ruler, squares and thickness (metres, in dataset.yaml). Glue back to back, both texts upright, pin through the crosses:"
        )
    size = min(3.2, (page[0] - 2 * left) / (0.5 * max(map(len, text))))
    shapes += [Text(left, foot + 14 + 4.2 * i, line, size) for i, line in enumerate(text)]
    return Sheet(*page, tuple(shapes))


def title(board: Board) -> str:
    """The board in words."""
    mm = 1000 * board.square_m
    if board.type == "aprilgrid":
        spacing = gap_m(board) / board.marker_m
        return (
            f"AprilGrid, tagCols {board.cols // 2}, tagRows {board.rows // 2}, tagSize {board.marker_m:.6g} m, "
            f"tagSpacing {spacing:.4g}"
        )
    return f"{board.cols} x {board.rows} inner corners, squares of {mm:g} mm"


def pattern(board: Board, x: float, y: float) -> list[Shape]:
    """What is black on the board, mm, with corner (0, 0) at (x, y)."""
    return [Fill(tuple(map(tuple, 1000 * rectangles_m(board) + [x, y, 0, 0])))]


def _marks(page: tuple[float, float], top: float, bottom: float) -> list[Shape]:
    """Crosses at the left and right of the pattern, level with its ends: symmetric, so that both faces' coincide."""
    shapes: list[Shape] = []
    inset, arm = _EDGE_MM / 2, 3.0
    for x in (inset, page[0] - inset):
        for y in (top, bottom):
            shapes += [Line(x - arm, y, x + arm, y), Line(x, y - arm, x, y + arm)]
    return shapes


def ruler(x: float, y: float, room: float) -> list[Shape]:
    """A ruler of 50 mm or of as many times 100 mm as there is room for, ticks every 10 mm."""
    length = max(50, 100 * int(room // 100))
    shapes: list[Shape] = [Line(x, y, x + length, y)]
    for mm in range(0, length + 1, 10):
        shapes.append(Line(x + mm, y, x + mm, y + (4 if mm % 100 == 0 else 2)))
        if mm % 100 == 0 or mm == length:
            shapes.append(Text(x + mm, y + 7, f"{mm} mm" if mm else "0", 2.5, centered=mm > 0))
    return shapes

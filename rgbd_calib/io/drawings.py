"""Vector drawings at true scale, written as PDF (reportlab) or SVG (drawsvg). Millimetres, origin top left, y down."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

from rgbd_calib.io.files import whole_file, write_text

_POINTS_PER_MM = 72 / 25.4
_FONT = "Helvetica"


@dataclass(frozen=True)
class Fill:
    """Rectangles (x, y, width, height) filled in one grey (0 black, 1 white), as one shape without seams."""

    rectangles: tuple[tuple[float, float, float, float], ...]
    gray: float = 0.0


@dataclass(frozen=True)
class Line:
    """A straight stroke."""

    x1: float
    y1: float
    x2: float
    y2: float
    width: float = 0.15


@dataclass(frozen=True)
class Text:
    """A line of text whose baseline starts at, or is centred on, (x, y); `size` is the height of the font."""

    x: float
    y: float
    text: str
    size: float = 3.0
    centered: bool = False


Shape = Fill | Line | Text


@dataclass(frozen=True)
class Sheet:
    """One page."""

    width: float
    height: float
    shapes: tuple[Shape, ...]


def write_pdf(path: Path, sheets: tuple[Sheet, ...], title: str) -> None:
    """Write one page for each sheet; same sheets, same bytes."""
    from reportlab.pdfgen.canvas import Canvas

    stream = io.BytesIO()
    canvas = Canvas(stream, invariant=1)
    canvas.setTitle(title)
    canvas.setViewerPreference("PrintScaling", "None")  # viewers then offer true scale first
    for sheet in sheets:
        canvas.setPageSize((sheet.width * _POINTS_PER_MM, sheet.height * _POINTS_PER_MM))
        canvas.scale(_POINTS_PER_MM, _POINTS_PER_MM)
        for shape in sheet.shapes:
            _draw_pdf(canvas, shape, sheet.height)
        canvas.showPage()
    canvas.save()
    with whole_file(path) as temporary:
        temporary.write_bytes(stream.getvalue())


def write_svg(path: Path, sheet: Sheet, title: str) -> None:
    """Write one sheet, its size in millimetres."""
    import drawsvg

    drawing = drawsvg.Drawing(sheet.width, sheet.height)
    drawing.set_render_size(f"{sheet.width}mm", f"{sheet.height}mm")
    drawing.append_title(title)
    for shape in sheet.shapes:
        drawing.append(_draw_svg(shape))
    write_text(path, drawing.as_svg())


def _draw_pdf(canvas, shape: Shape, height: float) -> None:  # type: ignore[no-untyped-def]
    if isinstance(shape, Fill):
        outline = canvas.beginPath()
        for x, y, w, h in shape.rectangles:
            outline.rect(x, height - y - h, w, h)
        canvas.setFillGray(shape.gray)
        canvas.drawPath(outline, stroke=0, fill=1)
    elif isinstance(shape, Line):
        canvas.setLineWidth(shape.width)
        canvas.line(shape.x1, height - shape.y1, shape.x2, height - shape.y2)
    else:
        canvas.setFillGray(0)
        canvas.setFont(_FONT, shape.size)
        draw = canvas.drawCentredString if shape.centered else canvas.drawString
        draw(shape.x, height - shape.y, shape.text)


def _draw_svg(shape: Shape):  # type: ignore[no-untyped-def]
    import drawsvg

    if isinstance(shape, Fill):
        level = round(255 * shape.gray)
        outline = drawsvg.Path(fill=f"#{level:02x}{level:02x}{level:02x}")
        for x, y, w, h in shape.rectangles:
            outline.M(x, y).h(w).v(h).h(-w).Z()
        return outline
    if isinstance(shape, Line):
        return drawsvg.Line(shape.x1, shape.y1, shape.x2, shape.y2, stroke="black", stroke_width=shape.width)
    anchor = "middle" if shape.centered else "start"
    family = f"{_FONT}, Arial, sans-serif"
    return drawsvg.Text(shape.text, shape.size, shape.x, shape.y, text_anchor=anchor, font_family=family)

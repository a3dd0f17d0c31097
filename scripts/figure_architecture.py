"""Draws docs/figures/architecture.svg: the rooms of the program, and what flows between them."""

from __future__ import annotations

from pathlib import Path

import drawsvg

OUT = Path(__file__).parents[1] / "docs" / "figures" / "architecture.svg"
BOX_W, BOX_H = 140, 56
INK, LINE, FILL, MAIN = "#263238", "#607d8b", "#eceff1", "#b2dfdb"
ROOMS: dict[str, tuple[int, int, str, str]] = {
    "sensors": (20, 20, "live cameras", FILL),
    "simulation": (20, 110, "rendered rooms, truth", FILL),
    "capture": (215, 20, "guided recording", FILL),
    "io": (215, 110, "files in and out", FILL),
    "views": (410, 110, "image to view", MAIN),
    "cameras": (605, 20, "intrinsics, depth bias", MAIN),
    "rig": (605, 110, "blocks, problem, solve", MAIN),
    "trust": (800, 110, "covariance, self-checks", MAIN),
    "report": (800, 20, "figures, page", FILL),
    "pipeline": (410, 215, "the order of the steps", "#ffe0b2"),
    "cli": (215, 215, "commands", "#ffe0b2"),
    "geometry, patterns": (605, 215, "arrays in, arrays out", FILL),
}
FLOWS = (
    ("sensors", "capture", "frames"),
    ("capture", "io", "recording"),
    ("simulation", "io", ""),
    ("io", "views", "images"),
    ("views", "cameras", ""),
    ("views", "rig", "views"),
    ("cameras", "rig", "lenses"),
    ("rig", "trust", "solution"),
    ("trust", "report", "verdict"),
    ("cli", "pipeline", ""),
    ("pipeline", "views", "calls"),
)


def main() -> None:
    drawing = drawsvg.Drawing(970, 290, font_family="system-ui, DejaVu Sans, sans-serif")
    drawing.append(drawsvg.Rectangle(0, 0, 970, 290, fill="white"))
    tip = drawsvg.Marker(-0.2, -0.5, 0.9, 0.5, scale=7, orient="auto")
    tip.append(drawsvg.Lines(-0.1, -0.4, -0.1, 0.4, 0.8, 0, fill=LINE, close=True))
    for start, end, what in FLOWS:
        x0, y0, x1, y1 = joined(ROOMS[start][:2], ROOMS[end][:2])
        drawing.append(drawsvg.Line(x0, y0, x1, y1, stroke=LINE, stroke_width=1.8, marker_end=tip))
        if what and y0 == y1:
            drawing.append(drawsvg.Text(what, 10.5, (x0 + x1) / 2, y0 - 6, text_anchor="middle", fill=INK))
        elif what:
            drawing.append(drawsvg.Text(what, 10.5, x0 + 6, (y0 + y1) / 2 + 4, fill=INK))
    for name, (x, y, what, fill) in ROOMS.items():
        drawing.append(drawsvg.Rectangle(x, y, BOX_W, BOX_H, rx=6, fill=fill, stroke=LINE))
        middle = x + BOX_W / 2
        drawing.append(drawsvg.Text(name, 14, middle, y + 24, text_anchor="middle", fill=INK, font_weight="bold"))
        drawing.append(drawsvg.Text(what, 11, middle, y + 43, text_anchor="middle", fill=INK))
    OUT.parent.mkdir(exist_ok=True)
    drawing.save_svg(str(OUT))


def joined(a: tuple[int, int], b: tuple[int, int]) -> tuple[float, float, float, float]:
    """Ends of the line between two boxes."""
    if a[1] == b[1]:
        return a[0] + BOX_W, a[1] + BOX_H / 2, b[0] - 7, b[1] + BOX_H / 2
    down = b[1] > a[1]
    if a[0] == b[0]:
        x = a[0] + BOX_W / 2
        return x, a[1] + (BOX_H if down else 0), x, b[1] + (-7 if down else BOX_H + 7)
    return a[0] + BOX_W, a[1] + BOX_H / 2, b[0] - 5, b[1] + BOX_H * (0.25 if down else 0.75)


if __name__ == "__main__":
    main()

"""The report's templates, and what stands in them: numbers, commands, pictures."""

from __future__ import annotations

import base64
import io
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbd_calib.io.plain import to_json_in_html

if TYPE_CHECKING:
    from rgbd_calib.report.plots import Figure

QUALITY = 80
"""Of pictures, as JPEG has it."""
_BETTER = "To make it better: "


def page(template: str, figures: dict[str, Figure], **values: Any) -> str:
    """A whole page of one of the templates, with plotly and the figures (by name) inside."""
    import jinja2
    from plotly.offline import get_plotlyjs

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rgbd_calib.report", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["commands"] = commands
    return environment.get_template(template).render(
        drawn=figures,
        figures_json=to_json_in_html({f"fig_{name}": own for name, own in figures.items()}),
        plotly=get_plotlyjs(),
        **values,
    )


def commands(text: str) -> Any:
    """Text with what stands between backticks as code, the rest escaped."""
    import markupsafe

    parts = [markupsafe.escape(part) for part in text.split("`")]
    return markupsafe.Markup("".join(f"<code>{p}</code>" if i % 2 else p for i, p in enumerate(parts)))


def jpeg(picture: np.ndarray, widest_px: int | None = None) -> tuple[str, float]:
    """A picture (h, w, 3), uint8, as a data URL, no wider than asked for, and how many of its pixels became one."""
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(picture))
    step = 1.0
    if widest_px is not None and image.width > widest_px:
        step = image.width / widest_px
        image = image.resize((widest_px, max(1, round(image.height / step))), Image.Resampling.LANCZOS)
    stream = io.BytesIO()
    image.save(stream, format="JPEG", quality=QUALITY, optimize=True)
    return "data:image/jpeg;base64," + base64.b64encode(stream.getvalue()).decode(), step


def by_camera(sentences: list[str], cameras: list[str]) -> list[str]:
    """Sentences that say the same of several cameras as one, with all their names; in the order of the first."""
    merged: dict[tuple[str, str, str], list[str]] = {}
    for text in sentences:
        head = _BETTER if text.startswith(_BETTER) else ""
        text = text[len(head) :]
        name = next((c for c in cameras if text.startswith((f"{c}: ", f"{c}'s "))), "")
        merged.setdefault((head, text[len(name) :], "" if name else text), []).append(name)
    out = []
    for (head, rest, _), names in merged.items():
        together = ", ".join(dict.fromkeys(names))
        several = len(set(names)) > 1 and rest.startswith("'s ")
        out.append(f"{head}{together}: {rest[3:]}" if several else f"{head}{together}{rest}")
    return out

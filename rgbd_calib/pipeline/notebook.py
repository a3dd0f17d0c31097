"""How results look in a notebook: tables in HTML without scripts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from rgbd_calib.types import Rig


def rig_html(rig: Rig) -> str:
    """Where each camera is, how sure that is, and its lens."""
    rows = []
    for name, own in rig.cameras.items():
        x, y, z = own.T_world_color[:3, 3]
        sd = np.sqrt(np.maximum(np.diag(own.covariance), 0))
        sure = f"± {1e3 * sd[3:].max():.2f} mm, ± {np.degrees(sd[:3].max()):.3f}°" if sd.any() else ""
        lens = own.intrinsics
        rows.append(
            (
                name,
                f"{x:.4f}, {y:.4f}, {z:.4f}",
                "reference" if name == rig.reference else sure,
                f"{lens.fx:.1f}, {lens.fy:.1f} ({lens.width} x {lens.height})",
                "yes" if own.depth_bias is not None or own.depth_field is not None else "no",
            )
        )
    return table(("camera", "position in m", "standard deviation", "focal length in px", "depth corrected"), rows)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; every text is escaped."""
    top = "".join(f"<th>{escape(text)}</th>" for text in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(text)}</td>" for text in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"

"""The page of two rigs side by side."""

from __future__ import annotations

from typing import Any

from rgbd_calib.geometry import se3
from rgbd_calib.report import error_map
from rgbd_calib.report.compare import Comparison, in_frame
from rgbd_calib.report.html import page
from rgbd_calib.report.plots import css_color
from rgbd_calib.report.scene import scene_of_two
from rgbd_calib.types import Rig


def render(rigs: tuple[Rig, Rig], found: Comparison) -> str:
    """The whole page, with its script, styles and figures inside."""
    a, b = rigs
    first, second = (in_frame(rig, found.frame) for rig in rigs)
    points_m, error_mm = error_map.points_of(a.quality)
    drawn, scale = scene_of_two(
        first, second, se3.transform(first.cameras[a.reference].T_world_color, points_m), error_mm
    )
    names = dict.fromkeys([*a.cameras, *b.cameras])
    return page(
        "compare.html",
        {"scene": drawn},
        title=f"{found.sides[0].name} and {found.sides[1].name}",
        found=found,
        scale=scale,
        volume=len(points_m) > 0,
        colors={name: css_color(i) for i, name in enumerate(names)},
    )


def numbers_of(found: Comparison) -> dict[str, Any]:
    """The same for programs."""
    return {
        "sentence": found.sentence,
        "frame": found.frame,
        "shared_images": found.shared_images,
        "untested": found.untested or None,
        "rigs": [
            {
                "name": side.name,
                "verdict": side.verdict.level,
                "expected": side.expected
                and {k: getattr(side.expected, k) for k in ("of", "mean_mm", "p95_mm", "worst_mm")},
                "measured": side.measured,
                "views": side.views,
                "recording": side.recording,
            }
            for side in found.sides
        ],
        "motions": {
            own.camera: {
                "position_m": own.step_m,
                "mm": own.mm,
                "sd_mm": own.sd_mm,
                "deg": own.deg,
                "sd_deg": own.sd_deg,
                "chance": own.chance,
                "moved": own.moved,
            }
            for own in found.motions
        },
        "cameras": {
            own.camera: {
                "lens_px": own.lens_px,
                "lens_sd_px": own.lens_sd_px,
                "lens_rms_px": own.rms_px if own.rms_px == own.rms_px else None,
                "depth_mm": [{"z_m": z, "mean_mm": mean, "rms_mm": rms} for z, mean, rms in own.depth_mm],
                "effect_mm": own.effect_mm,
            }
            for own in found.changed
        },
        "only": [list(names) for names in found.only],
    }

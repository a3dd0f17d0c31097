"""The end of a calibration in words: what a person at the rig wants to know."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rgbd_calib.errors import RgbdCalibError
from rgbd_calib.io.recording import Recording
from rgbd_calib.io.residuals import Residuals
from rgbd_calib.io.rig import read_rig_and_boards
from rgbd_calib.pipeline.evaluate import against_truth
from rgbd_calib.pipeline.frame_selection import told
from rgbd_calib.quality import Finding, MeasuredAlignment, Quality
from rgbd_calib.report.numbers import camera_table
from rgbd_calib.trust.verdict import Verdict
from rgbd_calib.types import Rig


def course(quality: Quality) -> list[str]:
    """What was used, what was dropped, and what the recording does not determine."""
    lines = []
    used, images = quality.views_used or {}, quality.images or {}
    if used:
        lines.append("Views used: " + ", ".join(f"{name} {used[name]} of {images[name]} images" for name in used))
    if quality.frame_selection is not None:
        lines.append(told(quality.frame_selection))
    lines += [f"{name}: {own.sentence}" for name, own in (quality.lenses or {}).items()]
    for reasons, what in ((quality.views_not_associated, "left out"), (quality.dropped, "dropped")):
        for name, frames in (reasons or {}).items():
            lines += [f"{name}: {_named(frame)} {what}: {why}" for frame, why in frames.items()]
    lines += merged(quality.not_observable or (), list(images))
    if quality.message is not None:
        lines.append(f"{quality.method}: {quality.message}")
    return lines


def _named(frame: str) -> str:
    """As people know it: frames of an intrinsic recording have their camera before their name."""
    *camera, own = frame.split(" alone: ")
    return f"frame {own} of its intrinsic recording" if camera else f"frame {own}"


def merged(sentences: Iterable[str], cameras: Sequence[str]) -> list[str]:
    """Sentences that differ only in the camera that they begin with, as one that names all of these cameras."""
    groups: dict[str, list[str]] = {}
    for text in sentences:
        name = next((c for c in sorted(cameras, key=len, reverse=True) if text.startswith((f"{c}'s ", f"{c}: "))), "")
        groups.setdefault(text[len(name) :], []).append(name)
    return [", ".join(names) + rest if names[0] else rest for rest, names in groups.items()]


def block(
    rig: Rig, verdict: Verdict, residuals: Residuals | None, truth: MeasuredAlignment | None = None
) -> tuple[list[str], list[str]]:
    """Rows of the cameras, and the lines that end a calibration: expected error, error against the truth, print, verdict."""
    quality = rig.quality
    lines = []
    expected, measured = quality.expected_alignment, quality.measured
    if expected is not None:
        least = "at least " if expected.lower_bound else ""
        lines.append(
            f"Expected error: {least}{expected.mean_mm:.2f} mm in the mean, 95 % of the volume below {expected.p95_mm:.2f} mm"
        )
    if truth is not None:
        own = truth.all
        lines.append(
            f"Error against the truth: {own.mean_mm:.2f} mm in the mean, 95 % of the volume below {own.p95_mm:.2f} mm"
        )
    if measured is not None and measured.median_mm is not None:
        lines.append(
            f"Measured on this recording: two cameras put the same corner {measured.median_mm:.2f} mm apart in the median "
            f"({measured.mean_mm:.2f} mm in the mean), including single-reading depth noise"
        )
    elif measured is not None and measured.median_board_mm is not None:
        lines.append(
            f"Measured on this recording: {measured.median_px:.2f} px between cameras in the median, or "
            f"{measured.median_board_mm:.2f} mm at the board; depth is not used"
        )
    lines += [own.text for own in quality.corrected or () if own.kind is not None and own.kind.of_board]
    lines.append(f"Verdict: {verdict}")
    findings = quality.self_check.findings if quality.self_check is not None else ()
    lines += [f"  {text}" for text in merged([_said(f, verdict) for f in findings], list(rig.cameras))]
    return _rows(rig, residuals), lines


def _said(finding: Finding, verdict: Verdict) -> str:
    """The cause and what to do; the cause only where the verdict has not named it."""
    text, advice = f"{finding.text}.", f"{finding.advice}."
    return advice if text in str(verdict) else f"{text} {advice}"


def truth_beside(recording: Recording, rig: Rig) -> MeasuredAlignment | None:
    """Errors against the truth.yaml of a simulated recording; None where there is none, or it is of other cameras."""
    path = recording.path.parent / "truth.yaml"
    if not path.exists():
        return None
    try:
        true, boards = read_rig_and_boards(path)
        return against_truth(rig, true, boards, recording.board or rig.quality.board).summary()
    except RgbdCalibError:
        return None


def numbers_of(rig: Rig, verdict: Verdict, truth: MeasuredAlignment | None) -> dict[str, Any]:
    """The same for programs."""
    expected = rig.quality.expected_alignment
    return {
        "verdict": verdict.level,
        "headline": verdict.headline,
        "reasons": list(verdict.reasons),
        "next_steps": list(verdict.next_steps),
        "film": merged(verdict.film, list(rig.cameras)),
        "expected": None if expected is None else replace(expected, grid=None, joint=None),
        "measured": rig.quality.alignment_on_recording,
        "truth": truth,
        "corrected": [own.text for own in rig.quality.corrected or ()],
        "cameras": {
            name: {
                "position_m": own.T_world_color[:3, 3],
                "sd_mm": 1e3 * float(np.sqrt(np.diag(own.covariance)[3:].max())),
                "sd_deg": float(np.degrees(np.sqrt(np.diag(own.covariance)[:3].max()))),
                "reference": name == rig.reference,
            }
            for name, own in rig.cameras.items()
        },
    }


def _rows(rig: Rig, residuals: Residuals | None) -> list[str]:
    table = camera_table(residuals, list(rig.cameras)) if residuals is not None else []
    seen = {row["camera"]: row for row in table}
    out = []
    for name, own in rig.cameras.items():
        sd = np.sqrt(np.maximum(np.diag(own.covariance), 0))
        sure = f"± {1e3 * sd[3:].max():.2f} mm, ± {np.degrees(sd[:3].max()):.3f}°" if sd.any() else ""
        x, y, z = own.T_world_color[:3, 3]
        text = f"{name}: at {x:+.4f} {y:+.4f} {z:+.4f} m  {'reference' if name == rig.reference else sure}".rstrip()
        row = seen.get(name)
        if row and row["views"]:
            text += f"; {row['views']} views, {row['rms_px']:.3f} px RMS"
            text += f", depth {row['rms_mm']:.2f} mm RMS" if np.isfinite(row["rms_mm"]) else ""
        out.append(text)
    return out

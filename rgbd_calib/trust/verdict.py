"""Whether to trust a calibration: one word, the numbers behind it, and what to do next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, Literal

import numpy as np

from rgbd_calib.quality import AlignmentNumbers, ExpectedAlignment, Finding, Quality

USUAL_M = 2.0
"""Working distance of a rig that does not state its own."""
ONE_PLACE = 1.5
"""Diagonal of the volume that the boards went through, over the board's, up to which they were at one place."""
MIN_COMMON_FRAMES = 3

Level = Literal["good", "fair", "poor", "untrusted", "unknown"]
_ORDER: tuple[Level, ...] = ("good", "fair", "poor", "untrusted")


@dataclass(frozen=True)
class VerdictLimits:
    """What is good enough: shares of the working distance, the median distance of the boards from the cameras."""

    good_share: float = 0.0015
    """Mean expected error up to which a rig is good: 3 mm at 2 m, half the noise of one depth pixel there (1.6e-3 z^2)."""
    fair_share: float = 0.005
    """Up to which it is fair: 10 mm at 2 m, beyond the noise of one depth pixel: it shows in every fused cloud."""
    noise_factor: float = 2.0
    """Limits for the median distance measured on the recording are so many times as wide: it has the noise of two depths."""

    def good_mm(self, distance_m: float) -> float:
        """At this working distance."""
        return 1e3 * self.good_share * distance_m

    def fair_mm(self, distance_m: float) -> float:
        """At this working distance."""
        return 1e3 * self.fair_share * distance_m


def limits_in(provenance: Mapping[str, Any]) -> VerdictLimits:
    """The limits that a rig was calibrated with; the defaults where it states none."""
    config = provenance.get("config")
    stated = config.get("verdict") if isinstance(config, Mapping) else None
    names = VerdictLimits.__dataclass_fields__
    if not isinstance(stated, Mapping):
        return VerdictLimits()
    return VerdictLimits(**{k: float(v) for k, v in stated.items() if k in names and isinstance(v, int | float)})


@dataclass(frozen=True)
class Reason:
    """A sentence behind a verdict."""

    text: str
    """Without its full stop."""
    grade: Level | None = None
    """How good the number in it is."""
    more: str = ""
    """What follows it, sentences."""
    finding: Finding | None = None
    tested: bool = False
    """It says that the self-checks found nothing."""

    @property
    def ungraded(self) -> str:
        return f"{self.text}.{self.more}"

    def __str__(self) -> str:
        return self.ungraded if self.grade is None else f"{self.text} ({self.grade}).{self.more}"


@dataclass(frozen=True)
class Verdict:
    level: Level
    headline: str
    because: tuple[Reason, ...]
    """The most important first."""
    next_steps: tuple[str, ...]
    film: tuple[str, ...] = ()
    """What to film to lower the expected error: the weakest pair of cameras, then what the recording does not determine."""

    @property
    def reasons(self) -> tuple[str, ...]:
        """Sentences, the most important first."""
        return tuple(map(str, self.because))

    def __str__(self) -> str:
        return self.headline

    def _repr_html_(self) -> str:
        reasons = "".join(f"<li>{escape(text)}</li>" for text in self.reasons)
        steps = "".join(f"<li>{escape(text)}</li>" for text in self.next_steps)
        return f"<p><strong>{escape(self.headline)}</strong></p><ul>{reasons}</ul><p>Next:</p><ol>{steps}</ol>"


def judge(
    quality: Quality,
    missing: Sequence[str],
    depth_noise_mm: float | None = None,
    limits: VerdictLimits = VerdictLimits(),
) -> Verdict:
    """Judge a rig's quality; `missing` are sentences of what was not filmed, `depth_noise_mm` is of one corner's depth.

    Raises
    ------
    ValueError
        A part of it is not as expected.
    """
    if quality.faults:
        raise ValueError("; ".join(quality.faults.values()))
    at_m = quality.working_distance_m or USUAL_M

    def level_of(mm: float, factor: float) -> Level:
        if mm <= limits.good_mm(at_m) * factor:
            return "good"
        return "fair" if mm <= limits.fair_mm(at_m) * factor else "poor"

    expected, measured = quality.expected_alignment, quality.measured or AlignmentNumbers(0)
    by_depth_mm, by_pixels_mm = measured.median_mm, measured.median_board_mm
    levels: list[Level] = []
    reasons: list[Reason] = []
    steps: list[str] = []
    if expected is not None:
        levels.append(level_of(expected.mean_mm, 1.0))
        text = (
            f"Expected error, from how well the recording determines every parameter: {_mm(expected.mean_mm)} in the "
        )
        reasons.append(Reason(f"{text}mean over the working volume", levels[-1]))
        if expected.lower_bound:
            text = "That counts the poses alone, lenses, depth and board taken as exact: the real error is larger. The method "
            reasons.append(Reason(f"{text}`bundle` counts all of them"))
    elif by_depth_mm is not None:
        levels.append("fair")
        reasons.append(Reason("This method does not tell how sure its poses are, so it is fair at best"))
    if by_depth_mm is not None:
        levels.append(level_of(by_depth_mm, limits.noise_factor))
        text = f"Measured on the recording itself: two cameras put the same board corner {_mm(by_depth_mm)} apart in the median, "
        more = f" Single depth readings scatter by {_mm(depth_noise_mm)} here, RMS." if depth_noise_mm else ""
        reasons.append(Reason(f"{text}the noise of two single depth readings included", levels[-1], more))
    elif by_pixels_mm is not None:
        levels.append(level_of(by_pixels_mm, 1.0))
        text = f"Measured on the recording itself, by pixels: a board that one camera locates is {measured.median_px:.2f} px off "
        reasons.append(
            Reason(f"{text}in another camera, or {_mm(by_pixels_mm)} at the board, in the median", levels[-1])
        )
    if levels:
        text = f"good up to {_mm(limits.good_mm(at_m))}, fair up to {_mm(limits.fair_mm(at_m))}"
        if by_depth_mm is not None:
            text += f"; {limits.noise_factor:g} times that for distances measured by depth"
        reasons.append(Reason(f"Limits at the working distance of {at_m:.1f} m: {text}"))
    checks = quality.self_check
    if checks is not None and (scale := checks.scale) is not None:
        text = f"by the depth its squares are {round(scale.percent, 3) + 0.0:+.3f} ± {scale.sd_percent:.3f} % from what was stated"
        own_mm, mm = 10 * scale.percent * scale.distance_m, _mm(10 * scale.sd_percent * scale.distance_m)
        text = f"Absolute scale depends on the board: {text}, or {own_mm:+.1f} ± {mm} at {scale.distance_m:.1f} m (one sigma)"
        reasons.append(Reason(text))
    weak, advice = _weaknesses(quality)
    reasons += weak
    steps += advice
    found = checks.findings if checks is not None else ()
    if checks is not None and found:
        levels.append("fair" if checks.trusted else "untrusted")
        reasons = [_finding(own) for own in found] + reasons
        steps = [_sentence(own.advice) for own in found if own.advice] + steps
    elif checks is not None and checks.tested:
        text = f"Self-checks: {checks.tested} tests of the residuals (over the image, the range, time and cameras, and with parts "
        text += "of the recording held out) found nothing that the stated errors leave out"
        reasons.append(Reason(text, tested=True))
    reasons += [Reason(own.text.removesuffix(".")) for own in quality.corrected or ()]
    if weak and levels:
        levels.append("fair")
    level: Level = max(levels, key=_ORDER.index) if levels else "unknown"
    weakest = [] if expected is None else _worst_pair(expected)
    if level in ("fair", "poor"):
        steps += weakest
    wanted = [_sentence(text) for text in (*(quality.not_observable or ()), *missing)]
    steps += [f"To make it better: {text}" for text in wanted] if level == "good" else wanted
    if level == "unknown":
        steps.insert(0, "Record depth too, and calibrate with it: without it no error in mm can be given.")
    if level == "good":
        steps.insert(0, "Use it. Whenever the rig may have been touched: `rgbd-calib verify RIG.yaml NEW_RECORDING`.")
    else:
        steps.append("Film what is asked for above, add it to the recording, and calibrate again.")
    headline = f"Do not trust this. {found[0].text}." if level == "untrusted" else _headline(level, expected, measured)
    return Verdict(level, headline, tuple(reasons), tuple(steps), (*weakest, *wanted))


def _finding(own: Finding) -> Reason:
    added = own.level == "caution" and own.effect_mm is not None
    more = f" Expect {_mm(own.effect_mm or 0.0)} more than the stated error." if added else ""
    return Reason(f"Self-check ({own.check}): {own.text.removesuffix('.')}", more=more, finding=own)


def _mm(value: float) -> str:
    return f"{value:.1f} mm" if value >= 1 else f"{value:.2f} mm"


def _headline(level: Level, expected: ExpectedAlignment | None, measured: AlignmentNumbers) -> str:
    if expected is not None and not (expected.lower_bound and measured.median_mm is not None):
        number = f"two cameras are expected to put the same point {_mm(expected.mean_mm)} apart "
        number += "inside the volume that the boards went through"
    elif measured.median_mm is not None:
        number = f"two cameras put the same point {_mm(measured.median_mm)} apart, sensor noise included"
    elif measured.median_board_mm is not None:
        number = f"two cameras put the same point {_mm(measured.median_board_mm)} apart at the board, across the line of sight"
    else:
        number = "the recording has no depth that two cameras share, so no error in mm is known"
    words = {
        "good": "Good.",
        "fair": "Fair: usable, with care.",
        "poor": "Poor: do not use it yet.",
        "unknown": "Unknown.",
    }
    return f"{words[level]} On average, {number}." if level != "unknown" else f"{words[level]} {number.capitalize()}."


def _weaknesses(quality: Quality) -> tuple[list[Reason], list[str]]:
    reasons, steps = [], []
    if quality.status in ("max_rounds", "round_limit"):
        reasons.append(Reason(f"The solution had not settled: {quality.message or ''}"))
        steps.append("Look at the dropped views and the residuals for a camera or frame that does not fit.")
    tied: dict[str, int] = {}
    for pair in quality.pairs or ():
        for name in pair.cameras:
            tied[name] = max(tied.get(name, 0), pair.agreeing)
    for name, frames in tied.items():
        if frames < MIN_COMMON_FRAMES:
            reasons.append(Reason(f"{name} is tied to the rig by {frames} common frame(s) with one other camera"))
            steps.append(
                f"Hold the board where {name} and a neighbour both see it, in {MIN_COMMON_FRAMES} or more poses."
            )
    expected, board = quality.expected_alignment, quality.board
    if board is not None and expected is not None and expected.grid is not None:
        across_m = np.ptp(expected.grid.points_in_reference_m, axis=0)
        if np.linalg.norm(across_m) < ONE_PLACE * np.linalg.norm(np.ptp(board.corners_m(), axis=0)):
            size = " x ".join(f"{side:.1f}" for side in across_m)
            text = "The board was at one place only: the volume for which errors are stated is"
            reasons.append(Reason(f"{text} {size} m, hardly larger than the board. Elsewhere they are not known"))
            steps.append("Show the board over the whole volume that you will use, near and far.")
    return reasons, steps


def _worst_pair(expected: ExpectedAlignment) -> list[str]:
    pair, own = max(expected.pairs.items(), key=lambda item: item[1].mean_mm)
    return [f"The weakest pair is {pair} ({_mm(own.mean_mm)}): show the board to both, near and far, tilted both ways."]


def _sentence(text: str) -> str:
    return text if text.endswith(".") else f"{text}."

"""Whether to trust a calibration: one word, the numbers behind it, and what to do next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, Literal

USUAL_M = 2.0
"""Working distance of a rig that does not state its own."""
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
class Verdict:
    level: Level
    headline: str
    reasons: tuple[str, ...]
    """Sentences, the most important first."""
    next_steps: tuple[str, ...]

    def __str__(self) -> str:
        return self.headline

    def _repr_html_(self) -> str:
        reasons = "".join(f"<li>{escape(text)}</li>" for text in self.reasons)
        steps = "".join(f"<li>{escape(text)}</li>" for text in self.next_steps)
        return f"<p><strong>{escape(self.headline)}</strong></p><ul>{reasons}</ul><p>Next:</p><ol>{steps}</ol>"


def judge(
    quality: Mapping[str, Any],
    missing: Sequence[str],
    depth_noise_mm: float | None = None,
    limits: VerdictLimits = VerdictLimits(),
) -> Verdict:
    """Judge a rig's quality; `missing` are sentences of what was not filmed, `depth_noise_mm` is of one corner's depth."""
    at_m = float(quality.get("working_distance_m", USUAL_M))

    def level_of(mm: float, factor: float) -> Level:
        if mm <= limits.good_mm(at_m) * factor:
            return "good"
        return "fair" if mm <= limits.fair_mm(at_m) * factor else "poor"

    expected, measured = quality.get("expected_alignment"), quality.get("alignment_on_recording", {}).get("all", {})
    levels: list[Level] = []
    reasons, steps = [], []
    if expected:
        levels.append(level_of(expected["mean_mm"], 1.0))
        reasons.append(
            f"Expected error, from how well the recording determines every parameter: {_mm(expected['mean_mm'])} in the "
            f"mean over the working volume ({levels[-1]})."
        )
        if _lower_bound(expected):
            reasons.append(
                "That counts the poses alone, intrinsics and depth taken as exact: the real error is larger. The method "
                "`bundle` counts all of them."
            )
    elif "median_mm" in measured:
        levels.append("fair")
        reasons.append("This method does not tell how sure its poses are, so it is fair at best.")
    if "median_mm" in measured:
        levels.append(level_of(measured["median_mm"], limits.noise_factor))
        reasons.append(
            f"Measured on the recording itself: two cameras put the same board corner {_mm(measured['median_mm'])} apart "
            f"in the median, the noise of two single depth readings included ({levels[-1]})."
            + (f" Single depth readings scatter by {_mm(depth_noise_mm)} here, RMS." if depth_noise_mm else "")
        )
    elif "median_board_mm" in measured:
        levels.append(level_of(measured["median_board_mm"], 1.0))
        reasons.append(
            f"Measured on the recording itself, by pixels: a board that one camera locates is {measured['median_px']:.2f} px off "
            f"in another camera, or {_mm(measured['median_board_mm'])} at the board, in the median ({levels[-1]})."
        )
    if levels:
        reasons.append(
            f"Limits at the working distance of {at_m:.1f} m: good up to {_mm(limits.good_mm(at_m))}, fair up to "
            f"{_mm(limits.fair_mm(at_m))}"
            + (
                f"; {limits.noise_factor:g} times that for distances measured by depth."
                if "median_mm" in measured
                else "."
            )
        )
    if scale := quality.get("self_check", {}).get("scale"):
        reasons.append(
            f"Absolute scale depends on the board: by the depth its squares are {round(scale['percent'], 3) + 0.0:+.3f} ± "
            f"{scale['sd_percent']:.3f} % from what was stated, or {_mm(10 * scale['sd_percent'] * scale['distance_m'])} at "
            f"{scale['distance_m']:.1f} m (one sigma)."
        )
    weak, advice = _weaknesses(quality)
    reasons += weak
    steps += advice
    checks = quality.get("self_check", {})
    found = checks.get("findings", [])
    if found:
        levels.append("fair" if checks["trusted"] else "untrusted")
        reasons = [_finding(own) for own in found] + reasons
        steps = [_sentence(own["advice"]) for own in found if own["advice"]] + steps
    elif checks.get("tested"):
        reasons.append(
            f"Self-checks: {checks['tested']} tests of the residuals (over the image, the range, time and cameras, and with "
            "parts of the recording held out) found nothing that the stated errors leave out."
        )
    reasons += [_sentence(text) for text in quality.get("corrected", [])]
    if weak and levels:
        levels.append("fair")
    level: Level = max(levels, key=_ORDER.index) if levels else "unknown"
    if level in ("fair", "poor") and expected:
        steps += _worst_pair(expected)
    wanted = [_sentence(text) for text in (*quality.get("not_observable", []), *missing)]
    steps += [f"To make it better: {text}" for text in wanted] if level == "good" else wanted
    if level == "unknown":
        steps.insert(0, "Record depth too, and calibrate with it: without it no error in mm can be given.")
    if level == "good":
        steps.insert(0, "Use it. Whenever the rig may have been touched: `rgbd-calib verify RIG.yaml NEW_RECORDING`.")
    else:
        steps.append("Film what is asked for above, add it to the recording, and calibrate again.")
    headline = (
        f"Do not trust this. {found[0]['text']}." if level == "untrusted" else _headline(level, expected, measured)
    )
    return Verdict(level, headline, tuple(reasons), tuple(steps))


def _finding(own: Mapping[str, Any]) -> str:
    if own["level"] == "distrust":
        return f"Self-check ({own['check']}): {_sentence(own['text'])}"
    more = f" Expect {_mm(own['effect_mm'])} more than the stated error." if "effect_mm" in own else ""
    return f"Self-check ({own['check']}): {_sentence(own['text'])}{more}"


def _lower_bound(expected: Mapping[str, Any]) -> bool:
    return str(expected["of"]).startswith("poses alone")


def _mm(value: float) -> str:
    return f"{value:.1f} mm" if value >= 1 else f"{value:.2f} mm"


def _headline(level: Level, expected: Mapping[str, Any] | None, measured: Mapping[str, Any]) -> str:
    if expected and not (_lower_bound(expected) and "median_mm" in measured):
        number = f"two cameras are expected to put the same point {_mm(expected['mean_mm'])} apart "
        number += "inside the volume that the boards went through"
    elif "median_mm" in measured:
        number = f"two cameras put the same point {_mm(measured['median_mm'])} apart, sensor noise included"
    elif "median_board_mm" in measured:
        number = f"two cameras put the same point {_mm(measured['median_board_mm'])} apart at the board, across the line of sight"
    else:
        number = "the recording has no depth that two cameras share, so no error in mm is known"
    words = {
        "good": "Good.",
        "fair": "Fair: usable, with care.",
        "poor": "Poor: do not use it yet.",
        "unknown": "Unknown.",
    }
    return f"{words[level]} On average, {number}." if level != "unknown" else f"{words[level]} {number.capitalize()}."


def _weaknesses(quality: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    reasons, steps = [], []
    if quality.get("status") in ("max_rounds", "round_limit"):
        reasons.append(f"The solution had not settled: {quality.get('message', '')}.")
        steps.append("Look at the dropped views and the residuals for a camera or frame that does not fit.")
    tied: dict[str, int] = {}
    for pair in quality.get("pairs", []):
        for name in pair["cameras"]:
            tied[name] = max(tied.get(name, 0), pair["agreeing"])
    for name, frames in tied.items():
        if frames < MIN_COMMON_FRAMES:
            reasons.append(f"{name} is tied to the rig by {frames} common frame(s) with one other camera.")
            steps.append(
                f"Hold the board where {name} and a neighbour both see it, in {MIN_COMMON_FRAMES} or more poses."
            )
    return reasons, steps


def _worst_pair(expected: Mapping[str, Any]) -> list[str]:
    pair, own = max(expected["pairs"].items(), key=lambda item: item[1]["mean_mm"])
    return [
        f"The weakest pair is {pair} ({_mm(own['mean_mm'])}): show the board to both, near and far, tilted both ways."
    ]


def _sentence(text: str) -> str:
    return text if text.endswith(".") else f"{text}."

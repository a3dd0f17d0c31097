"""No spoiled session is calibrated wrongly without a word; the study's own table, on small rigs, and what is said."""

from __future__ import annotations

import importlib.util
import sys
from functools import cache
from pathlib import Path

import pytest

from rgbd_calib.simulation.faults import FAULTS, RINGS

_PATH = Path(__file__).parents[1] / "scripts" / "study_silent_failures.py"
_SPEC = importlib.util.spec_from_file_location("study_silent_failures", _PATH)
assert _SPEC is not None
assert _SPEC.loader is not None
study = importlib.util.module_from_spec(_SPEC)
sys.modules["study_silent_failures"] = study  # dataclasses look themselves up by their module
_SPEC.loader.exec_module(study)

SMALL = {"cameras": 3, "frames": 15, "close": 8}

SAYS = {
    "square stated 1 % too large (print at 99 %)": "the board's squares are -",
    "square in cm": "board.square: 6.0 seen",
    "print 1 % too wide": "the board's squares are +0.5",
    "two_sided not stated": "common frames agree on the relative pose",
    "thickness stated 5 mm too small": "faces are +5",
    "cameras swapped in the intrinsic recording": "",
    "one camera's images mirrored": "C2",
    "one camera's images upside down, its intrinsics not": "C2",
    "a camera bumped half-way, 5 mm and 0.5 deg": "C2",
    "a lens refocused half-way (1 % of focal length)": "C2",
    "intrinsics file of another camera": "C2",
    "one camera's images from another session": "common frames agree",
    "depth in 0.1 mm, stated as mm": "All cameras agree",
    "depth of one camera in 0.1 mm, stated as mm": "C2: measured depth over the board's distance",
    "depth not registered to colour, 25 mm apart, all cameras": "beside its colour image",
    "one camera's depth saturated at 1.8 m": "C2",
    "depth bias of another camera": "C2",
    "all wall distances 5 cm too long": "",
    "wall distances in cm": "true distances are",
    "one clock 0.2 s late, the board moving at 0.15 m/s": "C2",
    "frames of one camera off by one": "common frames agree",
    "frames of one camera off by one from the middle on": "C2",
    "each instant copied six times": "places only",
    "close views all square to the camera": "focal length",
    "corners noisy by 1.5 px": "",
}
"""Words that must be said, of faults that do harm."""
HARMLESS = (
    "nothing",
    "board bent by 3 mm",
    "symmetric board, upside down in one camera always",
    "time stamps of one camera wrong by 0.2 s",
    "one camera without depth",
    "depth of one camera 10 px beside its colour",
)
"""The result is right, and nothing is said."""


@cache
def row(fault: str):
    return study.try_fault(fault, 0, **SMALL)


@cache
def clean(ring: bool):
    if ring:
        RINGS.add("nothing, in a ring")
        FAULTS["nothing, in a ring"] = FAULTS["nothing"]
    return row("nothing, in a ring" if ring else "nothing")


QUICK = (
    "square stated 1 % too large (print at 99 %)",
    "square in cm",
    "print 1 % too wide",
    "one camera's images mirrored",
    "one camera's images upside down, its intrinsics not",
    "a camera bumped half-way, 5 mm and 0.5 deg",
    "a lens refocused half-way (1 % of focal length)",
    "one camera's images from another session",
    "depth in 0.1 mm, stated as mm",
    "depth bias of another camera",
    "wall distances in cm",
    "one clock 0.2 s late, the board moving at 0.15 m/s",
    "frames of one camera off by one",
    "each instant copied six times",
)
"""Of these, that are tried in every run of the tests."""


@pytest.mark.parametrize("fault", [f if f in QUICK else pytest.param(f, marks=pytest.mark.slow) for f in SAYS])
def test_harm_is_an_error_or_a_warning_that_says_why(fault):
    own = row(fault)
    judged = own.judged(clean(fault in RINGS))
    assert judged in ("clear error", "warned", "right, warned"), own
    assert SAYS[fault] in own.says, own.says


@pytest.mark.parametrize("fault", HARMLESS)
def test_what_does_no_harm_is_not_made_a_fuss_of(fault):
    own = row(fault)
    assert own.judged(clean(False)) == "right", own


@pytest.mark.slow
@pytest.mark.parametrize("fault", [f for f in FAULTS if f not in SAYS and f not in HARMLESS])
def test_the_rest_is_not_silent_either(fault):
    own = row(fault)
    assert own.judged(clean(fault in RINGS)) != "SILENT", own


def test_at_least_thirty_ways():
    assert len(FAULTS) >= 30

"""No spoiled session is calibrated wrongly without a word; the study's own table, on small rigs, and what is said."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from rgbd_calib.simulation.faults import FAULTS
from rgbd_calib.simulation.faults.common import change_views, with_depths
from rgbd_calib.simulation.realism import Realism
from rgbd_calib.simulation.session import draw_scene, film
from rgbd_calib.trust.verdict import judge

_PATH = Path(__file__).parents[2] / "scripts" / "study_silent_failures.py"
sys.path.insert(0, str(_PATH.parent))
_SPEC = importlib.util.spec_from_file_location("study_silent_failures", _PATH)
assert _SPEC is not None
assert _SPEC.loader is not None
study = importlib.util.module_from_spec(_SPEC)
sys.modules["study_silent_failures"] = study  # dataclasses look themselves up by their module
_SPEC.loader.exec_module(study)

SMALL = {"cameras": 3, "frames": 15, "close": 8}
HARMLESS = (
    "nothing",
    "board bent by 3 mm",
    "depth magnified by 1 % in all cameras",
    "one camera without depth",
    "depth of one camera 10 px beside its colour",
)
"""The result is right, and nothing is said."""
QUICK = (
    "square in cm",
    "one camera's images from another session",
    "depth in 0.1 mm, stated as mm",
    "one camera's depth saturated at 1.8 m",
    "all wall distances 5 cm too long",
    "wall distances in cm",
    "one clock 0.2 s late, the board moving at 0.15 m/s",
    "frames of one camera off by one",
    "corners noisy by 1.5 px",
    "intrinsic recording with a board of 2 % smaller squares",
    "one camera's depth along its rays, not its axis",
)
"""Tried in every run of the tests, on a smaller session."""


@cache
def row(fault: str):
    return study.try_fault(fault, 0, **(SMALL if fault in (*QUICK, *HARMLESS) else {}))


@pytest.mark.parametrize("fault", [f if f in QUICK else pytest.param(f, marks=pytest.mark.slow) for f in study.CAUSES])
def test_harm_is_an_error_or_a_warning_that_names_the_cause(fault):
    own = row(fault)
    assert own.judged != "SILENT", own
    assert own.named is not False, own.says
    assert fault not in QUICK or own.named, own


@pytest.mark.parametrize("fault", HARMLESS)
def test_what_does_no_harm_is_not_made_a_fuss_of(fault):
    own = row(fault)
    assert own.judged == "right", own


@pytest.mark.slow
@pytest.mark.parametrize("fault", [f for f in FAULTS if f not in study.CAUSES and f not in HARMLESS])
def test_the_rest_is_not_silent_either(fault):
    own = row(fault)
    assert own.judged != "SILENT", own


def test_causes_are_of_spoilings():
    assert set(study.CAUSES) <= set(FAULTS) and len(FAULTS) >= 80


def test_an_unspoiled_session_is_within_its_bound():
    clean = study.false_alarm(16)  # of two cameras
    assert clean.trusted and clean.findings == ()
    assert 0.5 * clean.stated_mm < clean.bound_95_mm < 3 * clean.stated_mm
    assert clean.alignment_mm < clean.bound_95_mm


def test_cameras_without_depth_are_judged_by_their_pixels(tmp_path):
    scene = draw_scene(2, "arc", 15, 8, np.random.default_rng(3), realism=Realism())
    session = replace(film(scene, np.random.default_rng(3)), walls=None, wall_cells=None)
    for camera in scene.rig.cameras:
        session = change_views(session, camera, lambda v: with_depths(v, np.full(len(v.ids), np.nan)), close=True)
    quality = study.calibrate_session(session, tmp_path).rig.quality
    assert quality.self_check.findings == ()
    assert quality.self_check.scale is None  # pixels have no metre
    assert judge(quality, ()).level == "good"


@pytest.mark.parametrize(
    "name", ["square in cm", "one camera's images mirrored", "frames of one camera named from 100 on"]
)
def test_spoiled_files_are_refused_with_their_cause(real_data, name):
    own = study.try_files(name, study.SPOILINGS[name], real_data("realsense3"), None)
    assert own.judged == "clear error" and own.named, own

"""`quality` of a rig file, to and from records."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from qualities import expected, grid_of, measured
from synthetic_views import TWO_SIDED

from rgbd_calib.io.files import dump_yaml, plain
from rgbd_calib.io.quality import quality_data, quality_of, statistics_of
from rgbd_calib.io.safe_yaml import load
from rgbd_calib.quality import (
    BoardScaleEstimate,
    CarriedBoard,
    CorrectedProperty,
    Counted,
    Finding,
    InitialStep,
    LensChoice,
    PairViews,
    PropertyKind,
    Quality,
    SelfCheck,
    StartingCamera,
    StartingRig,
    WeightRound,
)
from rgbd_calib.trust.verdict import judge
from rgbd_calib.types import BoardShape


def whole(lens) -> Quality:
    found = Finding("walls", "caution", ("C1", "C2"), "Odd", "Look", effect_mm=2.5)
    return Quality(
        method="bundle",
        initialization=(InitialStep("C2", "C1", 9, "dlt"),),
        rounds=(WeightRound(cost=1.5, sigma_2d_px={"C1": 0.1}), WeightRound(sigma_2d_px=0.2)),
        dropped={},
        corrected=(CorrectedProperty("It is bent", PropertyKind.BEND), CorrectedProperty("And more")),
        pairs=(PairViews(("C1", "C2"), 9, 8, 1),),
        lenses={"C1": LensChoice("fisheye", {"brown": None, "fisheye": 0.12})},
        expected_alignment=expected(1.25, Counted.POSES, grid_of([[0, 0, 1.5]], [1.25])),
        alignment_on_recording=measured(median_mm=3.0),
        start=StartingRig("initialisation", {"C1": StartingCamera(np.eye(4), lens)}),
        self_check=SelfCheck(True, (found,), BoardScaleEstimate(0.1, 0.2, 1.5), tested=3),
        carried=CarriedBoard(3, {"C1 000001": "blurred"}, (), None, 2.5, "C1"),
        board=replace(TWO_SIDED, shape=BoardShape(TWO_SIDED.corners_m(), TWO_SIDED.corners_m(back=True))),
    )


def there_and_back(quality: Quality) -> Quality:
    return quality_of(load(dump_yaml({"quality": quality_data(quality)}))["quality"])


def test_records_survive_the_file(tiny):
    wrote = whole(tiny.rig.cameras["C1"].intrinsics)
    got = there_and_back(wrote)
    assert dump_yaml(quality_data(got)) == dump_yaml(quality_data(wrote))
    assert not got.faults and not got.other
    for name in (
        "method",
        "initialization",
        "rounds",
        "dropped",
        "corrected",
        "pairs",
        "lenses",
        "self_check",
        "carried",
    ):
        assert getattr(got, name) == getattr(wrote, name), name
    assert got.expected_alignment.of is Counted.POSES and got.dropped_rows is None
    np.testing.assert_array_equal(got.board.shape.back_m, wrote.board.shape.back_m)
    assert got.start.cameras["C1"].intrinsics == wrote.start.cameras["C1"].intrinsics


def test_keys_of_files_are_those_of_earlier_releases(tiny):
    data = quality_data(whole(tiny.rig.cameras["C1"].intrinsics))
    assert data["initialization"] == [{"camera": "C2", "from": "C1", "points": 9, "method": "dlt"}]
    assert data["corrected"] == ["It is bent", "And more"] and data["corrected_kinds"] == ["bend", None]
    assert data["expected_alignment"]["of"] == "poses alone; intrinsics and depth taken as exact"
    assert list(data["self_check"]) == ["trusted", "findings", "scale", "tested"]
    assert list(data["self_check"]["findings"][0]) == ["check", "level", "cameras", "text", "advice", "effect_mm"]
    assert data["carried"]["jerk_rad_per_s3"] is None and data["dropped"] == {} and "faults" not in data


def test_what_other_programs_wrote_is_kept():
    theirs = {
        "method": "theirs",
        "faults": 1,
        "other": {"a": 1},
        "rms_px": 0.5,
        "self_check": {
            "trusted": True,
            "findings": [],
            "scale": {},
            "tests": [{"test": "x", "camera": None, "freedom": 2}],
        },
        "corrected": ["The print is wider"],
    }
    got = quality_of(theirs)
    assert got.self_check.scale is None and got.corrected[0].kind is None and not got.faults
    del theirs["self_check"]["scale"]
    assert quality_data(there_and_back(got)) == theirs | {"corrected_kinds": [None]}


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("board", {"cols": 9}, r"^board.rows: Field required$"),
        ("pairs", 7, "pairs: 7 seen"),
        ("pairs", [{"cameras": ["C1"], "common_frames": 1, "agreeing": 1}], "argument"),
        ("expected_alignment", {"mean_mm": 1}, "missing"),
        ("images", {"C1": "x"}, "images.C1: 'x' seen, int needed"),
        ("status", True, "status: True seen, str needed"),
        ("cost", True, "cost: True seen, float needed"),
        ("corrected", [3], "corrected"),
        (
            "self_check",
            {"trusted": True, "findings": [{"level": "bad"}]},
            r"self_check.findings\[0\].level: 'bad' seen",
        ),
        (
            "start",
            {"poses_from": "x", "cameras": {"C1": {"T_world_color": [[1], [1, 2]]}}},
            r"start.cameras.C1.T_world_color: \[\[1\]",
        ),
    ],
)
def test_what_is_not_as_expected_is_kept_and_named(key, value, said):
    got = quality_of({"method": "bundle", key: value})
    assert list(got.faults) == [key] and getattr(got, key) is None and got.method == "bundle"
    assert quality_data(got) == {"method": "bundle", key: value}
    with pytest.raises(ValueError, match=said):
        judge(got, ())


def test_three_states_of_the_residuals():
    for stated in ({}, {"residuals_sha256": None}, {"residuals_sha256": "a" * 64}):
        assert quality_data(quality_of(stated)) == stated


def test_the_shape_of_a_simulated_board_stands_under_its_board():
    got = there_and_back(Quality(board_shape=BoardShape(TWO_SIDED.corners_m())))
    assert got.board is None
    np.testing.assert_array_equal(got.board_shape.front_m, TWO_SIDED.corners_m())


def test_statistics_of_a_camera_keep_what_is_not_as_expected():
    theirs = {"views": "many", "rms_px": 0.1, "lens_vendor": "ACME", "depth_statistics": {"views": 3, "model": "x"}}
    got = statistics_of(theirs)
    assert got.views is None and got.rms_px == 0.1 and got.depth_statistics.views == 3
    assert plain(got) == theirs

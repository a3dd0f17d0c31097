"""What the commands say of the self-check, and how they end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import synthetic_views as sv
from solved_rig import moved_from, solved
from test_self_check import PARAMS

from rgbd_calib.io.correspondences import write_corners
from rgbd_calib.io.files import load_yaml
from rgbd_calib.io.rig import read_rig
from rgbd_calib.report.page import Contents, render
from rgbd_calib.trust.self_check import (
    ALONE,
)
from rgbd_calib.trust.self_check.calibration import of_calibration
from rgbd_calib.trust.verdict import judge
from rgbd_calib.views.association import AssociationResult


@pytest.fixture(scope="module")
def wrong_square(tmp_path_factory):
    """A recording whose board is 5 % smaller than dataset.yaml says, with a bias recording to tell."""
    recording = sv.make_recording(tmp_path_factory.mktemp("square"), sv.arc(3, biased=True), frames=14)
    dataset = recording.path / "dataset.yaml"
    dataset.write_text(dataset.read_text().replace("square: 0.06", "square: 0.063"))
    return recording


def test_strict_exits_with_one_and_the_rig_is_there(run, wrong_square, tmp_path):
    r = wrong_square
    args = ("calibrate", r.path, "--corners", r.corners, "--intrinsics", r.intrinsics, "--depth-bias", r.depth_bias)
    lax = run(*args, "-o", tmp_path / "lax.yaml")
    assert lax.status == 0, lax.stderr
    out = run(*args, "-o", tmp_path / "rig.yaml", "--strict")
    assert out.status == 1
    assert "Do not trust this" in out.stderr
    assert "Measure the print" in out.stderr
    lines = out.stderr.splitlines()
    cause = next(line for line in lines if "Do not trust this" in line).split("Do not trust this. ")[1]
    assert out.stderr.count(cause) == 1
    rig = read_rig(tmp_path / "rig.yaml")
    assert rig.quality.self_check.trusted is False
    assert any(f.level == "distrust" for f in rig.quality.self_check.findings)
    assert judge(rig.quality, ()).level == "untrusted"
    assert "Do not trust this" in render(Contents("rig.yaml", rig, {}, None))


def test_a_good_recording_passes_strictly(run, tmp_path):
    r = sv.make_recording(tmp_path, sv.arc(3, biased=True), frames=14)
    for method in ("bundle", "biobjective"):
        out = run(
            "calibrate", r.path, "--corners", r.corners, "--intrinsics", r.intrinsics, "--depth-bias", r.depth_bias,
            "--method", method, "--strict", "-o", tmp_path / f"{method}.yaml",
        )  # fmt: skip
        assert out.status == 0, out.stderr
        assert load_yaml(tmp_path / f"{method}.yaml")["quality"]["self_check"]["trusted"] is True


def test_a_camera_moved_half_way_is_named_by_every_method(run, tmp_path):
    """The estimators that take lenses as given say at least that the frames do not agree, or that noise is another one."""
    r = sv.make_recording(tmp_path, sv.arc(3, biased=True), frames=16)
    views = moved_from(r.views, "000008", "C2", lambda v: replace(v, corners_px=v.corners_px + [3.0, 2.0]))
    write_corners(r.corners, views)
    out = run(
        "calibrate", r.path, "--corners", r.corners, "--intrinsics", r.intrinsics, "--depth-bias", r.depth_bias,
        "--strict", "-o", tmp_path / "rig.yaml",
    )  # fmt: skip
    assert out.status == 1
    assert "C2" in out.stderr.split("Verdict:")[1]
    assert ALONE == -1


def test_refine_tells_where_given_sigmas_are_too_small(run, tmp_path):
    r = sv.make_recording(tmp_path, sv.arc(3), frames=10)
    csv = tmp_path / "c.csv"
    args = ("--corners", r.corners, "--intrinsics", r.intrinsics, "--correspondences", csv, "--method", "biobjective")
    assert run("calibrate", r.path, *args, "-o", tmp_path / "a.yaml").status == 0
    refine = ("refine", csv, "--intrinsics", r.intrinsics, "--strict")
    good = run(*refine, "-o", tmp_path / "b.yaml")
    assert good.status == 0, good.stderr
    assert load_yaml(tmp_path / "b.yaml")["quality"]["self_check"]["trusted"] is True
    bad = run(*refine, "--sigma-2d", "0.02", "--sigma-3d", "0.003", "-o", tmp_path / "c.yaml")
    assert bad.status == 1
    assert "Pixels scatter" in bad.stderr
    assert (tmp_path / "c.yaml").exists()


def test_a_check_that_cannot_be_made_is_not_passed(monkeypatch):
    result, frames = solved(sv.arc(3, biased=True), 0)

    def singular(*args):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr("rgbd_calib.trust.self_check.calibration.outcomes_of", singular)
    nothing = AssociationResult((), {}, {}, (), "C1")
    check = of_calibration(result, None, [], nothing, sv.BOARD, frames, 0.0, PARAMS)
    assert check.trusted is False
    assert "could not be checked" in check.findings[0].text

"""A long recording calibrated from the frames that tell most: what is kept, what is said, and whether it is true."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from synthetic_views import BOARD, arc, make_recording

from rgbd_calib.io.rig import read_rig
from rgbd_calib.pipeline import frame_selection
from rgbd_calib.pipeline.checked_views import prepare_views
from rgbd_calib.pipeline.config import load_config
from rgbd_calib.pipeline.detection import Detections
from rgbd_calib.pipeline.evaluate import against_truth
from rgbd_calib.rig.frame_selection import choose_frames

FRAMES, FEW = 48, 12


@pytest.fixture(scope="module")
def long(tmp_path_factory):
    return make_recording(tmp_path_factory.mktemp("long"), arc(3, biased=True), frames=FRAMES)


@pytest.fixture(scope="module")
def whole(long):
    """The prepared views of all frames, and what the choice needs besides."""
    from rgbd_calib.io.recording import open_recording

    config = load_config(None)
    recording = open_recording(long.path)
    views = prepare_views(recording, config, long.intrinsics, long.depth_bias, Detections(tuple(long.views), ()))
    priors = frame_selection.bundle_priors(views.lenses, views.depth, recording, config.bundle)
    return views, priors


def chosen(whole, n, views=None):
    prepared, priors = whole
    association = prepared.association
    return choose_frames(
        association.views if views is None else views, [], BOARD, priors, association.T_world_color, "C1", n
    )


def log_det(choice, units):
    """Of the covariance, free parameters only, in `units`: what is made small."""
    free = units > 0
    return np.linalg.slogdet(choice.covariance[np.ix_(free, free)] / np.outer(units[free], units[free]))[1]


def pairs_of(views):
    by_frame = {}
    for placed in views:
        by_frame.setdefault(placed.view.frame, set()).add(placed.view.camera)
    return {pair for cameras in by_frame.values() for pair in combinations(sorted(cameras), 2)}


def test_the_frames_tell_more_than_any_of_many_random_choices(whole):
    choice = chosen(whole, FEW)
    assert len(choice.chosen) == FEW and len(choice.left_out) == FRAMES - FEW
    assert chosen(whole, FEW).chosen == choice.chosen
    units = np.sqrt(np.diag(choice.covariance_of_all))
    rng, best = np.random.default_rng(0), log_det(choice, units)
    for _ in range(20):
        names = set(rng.choice(sorted({*choice.chosen, *choice.left_out}), FEW, replace=False))
        some = chosen(whole, FEW, [p for p in whole[0].association.views if p.view.frame in names])
        assert set(some.chosen) == names and log_det(some, units) > best


def test_all_frames_are_all(whole):
    choice = chosen(whole, FRAMES)
    assert choice.left_out == ()
    np.testing.assert_allclose(choice.covariance, choice.covariance_of_all, rtol=1e-9, atol=1e-18)


def test_the_order_of_the_views_does_not_matter(whole):
    assert chosen(whole, FEW, whole[0].association.views[::-1]).chosen == chosen(whole, FEW).chosen


def test_every_pair_of_cameras_keeps_a_frame(whole):
    """One frame alone joins C1 and C3; it says little, and stays."""
    views = whole[0].association.views
    shared = sorted({p.view.frame for p in views if p.view.camera == "C3"})[3]
    sparse = [
        p for p in views if p.view.frame == shared or p.view.camera == ("C1" if p.view.frame < "000024" else "C3")
    ]
    sparse += [p for p in views if p.view.camera == "C2" and p.view.frame != shared]
    assert pairs_of(sparse) == {("C1", "C2"), ("C1", "C3"), ("C2", "C3")}
    choice = chosen(whole, 4, sparse)
    assert shared in choice.chosen
    assert pairs_of([p for p in sparse if p.view.frame in choice.chosen]) == pairs_of(sparse)


def test_the_command_says_what_is_lost_and_it_is_so(long, run, tmp_path):
    sources = ("--intrinsics", long.intrinsics, "--depth-bias", long.depth_bias, "--corners", long.corners)
    told = {}
    for name, options in (("few", ("--max-views", FEW)), ("all", ("--max-views", FRAMES))):
        told[name] = run("calibrate", long.path, *sources, *options, "-o", tmp_path / f"{name}.yaml")
        assert told[name].status == 0, told[name].stderr
    few, whole = read_rig(tmp_path / "few.yaml"), read_rig(tmp_path / "all.yaml")
    assert whole.quality.frame_selection is None and "most informative" not in told["all"].stderr
    own = few.quality.frame_selection
    assert (own.frames, own.used, len(own.left_out)) == (FRAMES, FEW, FRAMES - FEW)
    assert all(count <= FEW for count in few.quality.views_used.values())
    assert f"{FEW} of {FRAMES} frames used, the most informative: expected error" in told["few"].stderr
    # the estimate for all takes the same sigmas; those of few frames are known to a tenth, and a part of the expectation
    # does not fall with the number of frames
    expected_mm = whole.quality.expected_alignment.mean_mm
    assert 0.6 * expected_mm < own.expected_mm_with_all < 1.3 * expected_mm
    assert own.expected_mm == pytest.approx(few.quality.expected_alignment.mean_mm, abs=1e-3)
    error_mm = 1e3 * float(against_truth(few, long.rig, long.boards, BOARD).distance_m.mean())
    assert error_mm < 4 * own.expected_mm  # the mean over a volume of one draw: a few numbers' worth of chance


def test_too_few_and_wrong_company_are_errors(long, run, tmp_path):
    rig = tmp_path / "rig.yaml"
    assert run("calibrate", long.path, "--max-views", 2, "-o", rig).status == 2
    outcome = run("calibrate", long.path, "--update", rig, "--only", "C2", "--max-views", 9)
    assert outcome.status == 2 and "--max-views goes without --update" in outcome.stderr


def test_more_pairs_than_frames_is_said(whole):
    from dataclasses import replace

    from rgbd_calib.errors import CalibrationError

    views = [p for p in whole[0].association.views if p.view.frame in ("000000", "000001")]
    apart = [replace(p, view=replace(p.view, frame=f"{p.view.frame}{k}")) for k, p in enumerate(views)]
    pairs = [
        replace(p, view=replace(p.view, frame=f"{a}{b}"))
        for a, b in combinations(("C1", "C2", "C3"), 2)
        for p in {p.view.camera: p for p in apart}.values()
        if p.view.camera in (a, b)
    ]
    with pytest.raises(CalibrationError, match=r"--max-views 2: 3 frames are needed"):
        chosen(whole, 2, pairs)

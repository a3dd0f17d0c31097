"""The self-checks of what changed while or between recordings: cameras that moved, depth that drifted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import synthetic_views as sv
from solved_rig import NOISE, moved_from, solved

from rgbd_calib.geometry import se3
from rgbd_calib.simulation.views import true_views
from rgbd_calib.trust.self_check import SelfCheckParams, check_steps
from rgbd_calib.trust.self_check.calibration import check_bundle
from rgbd_calib.types import BoardView, PlacedView
from rgbd_calib.views.association import AssociationResult

PARAMS = SelfCheckParams()


@pytest.mark.parametrize("moved", ["C1", "C2"])
def test_of_two_cameras_either_may_have_moved(moved):
    rig = sv.arc(2, biased=True)
    own = rig.cameras[moved]
    elsewhere = replace(
        own, T_world_color=own.T_world_color @ se3.retract(np.eye(4), np.array([0, 0.01, 0, 0.01, 0, 0]))
    )
    later = replace(rig, cameras={**rig.cameras, moved: elsewhere})

    def change(views, rng):
        boards = sv.board_poses(rig, sv.BOARD, 14, np.random.default_rng(1))
        late = {frame: T for frame, T in boards.items() if frame >= "000007"}
        return [*(v for v in views if v.frame < "000007"), *true_views(later, late, sv.BOARD, NOISE, rng)]

    result, frames = solved(rig, 1, change=change)
    views = [p.view for p in result.course.views if p.view.frame in frames]
    boards, rng = sv.board_poses(rig, sv.BOARD, 14, np.random.default_rng(1)), np.random.default_rng(2)
    placed = []  # as each view's own pixels put its board
    for v in views:
        T_world_color = (later if v.frame >= "000007" else rig).cameras[v.camera].T_world_color
        T_color_board = se3.retract(se3.inverse(T_world_color) @ boards[v.frame], rng.normal(0, 1e-3, 6))
        placed.append(PlacedView(v, False, False, T_color_board))
    check = check_bundle(
        result, sv.BOARD, views, AssociationResult(tuple(placed), {}, {}, (), "C1"), frames, 0.0, PARAMS
    )
    first = check.findings[0]
    assert (first.check, first.cameras) == ("pose over time", ("C1", "C2"))
    assert "at frame 000007" in first.text


@pytest.mark.parametrize(("drift_m", "said"), [(0.006, False), (0.04, True)])
def test_time_of_flight_may_have_drifted_between_recordings(drift_m, said):
    def change(views, rng):
        return moved_from(views, "", "C2", lambda v: replace(v, depth_m=v.depth_m + drift_m))

    result, frames = solved(sv.arc(3, biased=True), 1, change=change, time_of_flight=True)
    own = result.problem.index("depth drift", 1)
    by_distance = np.array([1.0, 1.5])
    found = by_distance @ result.state.values["depth drift"][1]
    sd = np.sqrt(by_distance @ result.covariance[np.ix_(own, own)] @ by_distance)
    assert sd < 0.002
    assert said or abs(found - drift_m) < 3 * sd  # its prior of 5 mm draws 40 mm to itself
    views = [p.view for p in result.course.views if p.view.frame in frames]
    check = check_bundle(result, sv.BOARD, views, AssociationResult((), {}, {}, (), "C1"), frames, 0.0, PARAMS)
    named = [f.cameras for f in check.findings if f.check == "depth between recordings"]
    assert named == ([("C2",)] if said else [])
    assert check.trusted != said, [f.text for f in check.findings]


@pytest.mark.parametrize("motion", [None, [0.0, 0.0, 0.03, 0.0, 0.05, 0.0]], ids=["at rest", "mounted anew"])
def test_a_step_of_the_relative_pose_is_named_with_its_frame(motion):
    rng = np.random.default_rng(2)
    frames = [f"{k:03d}" for k in range(20)]
    placed = []
    for k, frame in enumerate(frames):
        T_c1_board = se3.retract(np.eye(4), np.array([*rng.normal(0, 0.3, 5), 2.0]))
        moved = np.asarray(motion) if motion and k >= 12 else np.zeros(6)
        for camera, T in (("C1", T_c1_board), ("C2", se3.retract(T_c1_board, moved + rng.normal(0, 3e-3, 6)))):
            view = BoardView(camera, frame, np.zeros(0, int), np.zeros((0, 2)), np.zeros(0), np.zeros(0, int))
            placed.append(PlacedView(view, False, False, T))
    found = check_steps(placed, frames, PARAMS)
    assert [f.text for f in found] == (["C1 and C2: their relative pose changed at frame 012"] if motion else [])

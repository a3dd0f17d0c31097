"""Coverage by hand-made views: regions, distances, tilts, links between cameras, and the sentences about them."""

import math

import cv2
import numpy as np
import pytest

from rgbd_calib.types import Board, BoardView
from rgbd_calib.views.coverage import CoverageParams, measure_coverage, nominal_intrinsics, place_view

BOARD = Board(9, 6, 0.06)
SIZE = (640, 480)


def view(camera="C1", frame="000000", x_m=0.0, y_m=0.0, z_m=1.5, tilt_deg=0.0, ids=None):
    """A board whose middle stands at (x, y, z) before an Xtion, turned by `tilt_deg` about its own upright axis."""
    ids = np.arange(BOARD.n_corners) if ids is None else np.array(ids)
    points = BOARD.corners_m() - BOARD.corners_m().mean(axis=0)
    R = cv2.Rodrigues(np.array([0.0, math.radians(tilt_deg), 0.0]))[0]
    p = points @ R.T + np.array([x_m, y_m, z_m])
    K = nominal_intrinsics(SIZE).K
    pixels = (p[:, :2] / p[:, 2:]) @ K[:2, :2].T + K[:2, 2]
    n = len(ids)
    return BoardView(camera, frame, ids, pixels[ids], np.full(n, np.nan), np.zeros(n, int))


@pytest.mark.parametrize("z_m", [0.7, 1.5, 3.0])
@pytest.mark.parametrize("tilt_deg", [0, 20, 40])
def test_finds_distance_and_tilt(z_m, tilt_deg):
    placed = place_view(view(z_m=z_m, tilt_deg=tilt_deg), BOARD, SIZE)
    assert placed.distance_m == pytest.approx(z_m, abs=1e-4)  # exact pixels: only the solver's own rounding is left
    assert math.degrees(placed.tilt_rad) == pytest.approx(tilt_deg, abs=0.1)


def test_collinear_corners_have_no_pose_but_fill_regions():
    placed = place_view(view(ids=range(9)), BOARD, SIZE)
    assert math.isnan(placed.distance_m) and placed.regions.sum() > 0


def test_says_which_regions_are_empty():
    coverage = measure_coverage([view(x_m=-0.5, y_m=-0.3)], BOARD, {"C1": SIZE})
    assert coverage.cameras["C1"].regions[0, 0] == 1 and coverage.cameras["C1"].regions[2, 3] == 0
    assert any("image regions" in s and "right" in s for s in coverage.missing)


def test_names_the_pair_without_a_common_view():
    views = [view(c, f"{i:06d}") for c, i in [("C1", 0), ("C2", 0), ("C1", 1), ("C2", 1), ("C1", 2), ("C2", 2)]]
    coverage = measure_coverage(views, BOARD, {"C1": SIZE, "C2": SIZE, "C3": SIZE})
    assert coverage.common_frames == {("C1", "C2"): 3, ("C1", "C3"): 0, ("C2", "C3"): 0}
    assert "C1 and C3 share no view yet: hold the board where both see it" in coverage.missing
    assert "C3 has not seen the board yet: hold the board in front of it" in coverage.missing
    assert coverage.next == "C1 and C3: hold the board where both see it"
    assert not any(s.startswith("C2 and C3") for s in coverage.missing)  # one link is enough for C3
    assert not coverage.enough


def test_a_chain_of_pairs_is_enough():
    params = CoverageParams(judge_cameras=False)
    views = [view(c, f"{pair}{i}") for pair in ("AB", "BC") for i in range(3) for c in pair]
    coverage = measure_coverage(views, BOARD, {c: SIZE for c in "ABC"}, params=params)
    assert coverage.enough and coverage.common_frames["A", "C"] == 0


def test_counts_what_a_pair_still_lacks():
    views = [view(c, "000000") for c in ("C1", "C2")]
    missing = measure_coverage(
        views, BOARD, {"C1": SIZE, "C2": SIZE}, params=CoverageParams(judge_cameras=False)
    ).missing
    assert missing == ("C1 and C2 share 1 view, 2 more needed: hold the board for both",)


def test_one_camera_recorded_alone_becomes_enough():
    views = [
        view(frame=f"{i:06d}", x_m=x * z, y_m=y * z, z_m=z, tilt_deg=t)
        for i, (x, y, z, t) in enumerate(
            (x, y, z, t) for z, t in ((0.8, 0), (1.2, 25)) for x in (-0.35, 0, 0.35) for y in (-0.25, 0.25)
        )
    ]
    coverage = measure_coverage(views, BOARD, {"C1": SIZE}, params=CoverageParams(judge_pairs=False))
    assert coverage.enough, coverage.missing
    flat = measure_coverage([view(frame=str(i)) for i in range(9)], BOARD, {"C1": SIZE})
    assert len(flat.missing) == 3  # regions, distances and tilts, each with its own sentence


def test_shared_views_are_asked_for_before_close_ones():
    params = CoverageParams(judge_alone=True)
    shared = [view(c, f"{i:06d}", z_m=1.2 + 0.1 * i, tilt_deg=20 * (i % 2)) for i in range(8) for c in ("C1", "C2")]
    sizes = {"C1": SIZE, "C2": SIZE}
    few = measure_coverage(shared[:6], BOARD, sizes, params=params)
    assert few.connected and not few.shared_enough
    assert few.next == "C1: show it more poses" and not any("close" in s for s in few.missing)
    alone = [view("C1", f"alone{i}", x_m=0.2 * (i - 2), y_m=0.1 * (i - 2), z_m=0.7) for i in range(5)]
    assert not measure_coverage(alone, BOARD, sizes, params=params).connected
    enough = measure_coverage(shared, BOARD, sizes, params=params)
    assert enough.shared_enough and enough.missing[0].startswith("C1: 0 close views, 5 needed: hold the board close")
    close = measure_coverage([*shared, *alone], BOARD, sizes, params=params)
    assert close.missing[0].startswith("C2: 0 close views") and not any("C1: 0 close" in s for s in close.missing)


def test_nothing_seen_is_said_for_every_camera():
    coverage = measure_coverage([], BOARD, {"C1": SIZE, "C2": SIZE})
    assert len(coverage.missing) == 3 and math.isnan(coverage.cameras["C1"].nearest_m)

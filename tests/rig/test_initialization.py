"""First poses: the DLT, the homography of a plane, rigid alignment, and cameras that nothing joins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from refinement_cases import make
from synthetic_views import arc, pose_errors

from rgbd_calib.errors import CalibrationError
from rgbd_calib.geometry import camera, se3
from rgbd_calib.rig.initialization import initialize
from rgbd_calib.types import Correspondences, Rig

LENSES = {name: own.intrinsics for name, own in arc(4).cameras.items()}


def observe(rig: Rig, points: np.ndarray, rng, sigma_px=0.2, sigma_m=0.004, pixels=None, depths=None, who=None):
    """Points (n, 3) in the world, seen by all cameras; `pixels`, `depths`: only by these; `who`: points by camera."""
    rows: dict[str, list] = {"px": [], "xyz": []}
    for i, (name, own) in enumerate(rig.cameras.items()):
        at = np.arange(len(points)) if who is None else np.asarray(who[name])
        p = se3.transform(se3.inverse(own.T_world_color), points[at])
        if pixels is None or name in pixels:
            px = camera.project(own.intrinsics.vector, p) + rng.normal(0, sigma_px, (len(p), 2))
            rows["px"] += [(i, k, *v) for k, v in zip(at, px, strict=True)]
        if depths is None or name in depths:
            rows["xyz"] += [(i, k, *v) for k, v in zip(at, p + rng.normal(0, sigma_m, p.shape), strict=True)]
    a, b = np.array(rows["px"]).reshape(-1, 4), np.array(rows["xyz"]).reshape(-1, 5)
    return Correspondences(
        tuple(rig.cameras),
        tuple(("0", str(k)) for k in range(len(points))),
        a[:, 0].astype(int),
        a[:, 1].astype(int),
        a[:, 2:],
        b[:, 0].astype(int),
        b[:, 1].astype(int),
        b[:, 2:],
    )


def volume(rng, n=80):
    """Points around the middle of what all cameras look at, in the world of the first."""
    return rng.uniform([-0.5, -0.35, 1.6], [0.5, 0.35, 2.4], (n, 3))


def plane(rng, n=54):
    points = np.column_stack([rng.uniform(-0.3, 0.3, n), rng.uniform(-0.2, 0.2, n), np.zeros(n)])
    return points @ np.array([[0.95, 0.1, 0.3], [-0.1, 1.0, 0.1], [0, 0, 1]]) + [0, 0, 2.0]


def check(result, rig: Rig, rotation_deg: float, shift_m: float) -> None:
    for name, (rotation_rad, off_m) in pose_errors(result.T_world_color, rig).items():
        assert np.degrees(rotation_rad) < rotation_deg, name
        assert off_m < shift_m, name


@pytest.mark.parametrize("seed", range(5))
def test_dlt(seed):
    """Points of 4 mm noise over 1 m, 80 of them, at 2 m: as 1 px of noise; a DLT is several times worse than least
    squares: 1 px / 540 / sqrt(80) = 0.2 mrad of direction, times 10 for leverage and a chain, is 0.12 degrees: five of these,
    and at 2 m 0.6 degrees are 21 mm."""
    rig, rng = arc(4), np.random.default_rng(seed)
    result = initialize(observe(rig, volume(rng), rng), LENSES, "C1")
    assert [(s.method, s.points) for s in result.steps] == [("dlt", 80)] * 3
    check(result, rig, 0.6, 0.03)
    np.testing.assert_array_equal(result.T_world_color["C1"], np.eye(4))


@pytest.mark.parametrize("seed", range(5))
def test_homography_of_one_plane(seed):
    rig, rng = arc(4), np.random.default_rng(seed)
    result = initialize(observe(rig, plane(rng), rng), LENSES, "C1")
    assert {s.method for s in result.steps} == {"homography"}
    check(result, rig, 1.5, 0.06)  # the plane's tilt is known to 4 mm over 0.2 m / sqrt(54): 0.2 degrees, three a chain


def test_points_measured_by_both_choose_between_the_two_poses_of_a_plane():
    """A patch of 6 cm at 2 m: its two poses differ by a third of a pixel."""
    rig = arc(2, 40.0)
    wrong = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        points = (plane(rng) - [0, 0, 2.0]) * 0.15 + [0, 0, 2.0]
        T = initialize(observe(rig, points, rng, 0.3, 0.001), LENSES, "C1").T_world_color["C2"]
        wrong += np.degrees(np.linalg.norm(se3.difference(T, rig.cameras["C2"].T_world_color)[:3])) > 20
    assert wrong == 0


def test_rigid_alignment_of_bare_points():
    rig, rng = arc(3), np.random.default_rng(0)
    result = initialize(observe(rig, volume(rng), rng, pixels=()), LENSES, "C1")
    assert {s.method for s in result.steps} == {"rigid"}
    # 4 mm sqrt(2) / sqrt(80) = 0.6 mm at the middle, over 0.35 m: 0.1 degrees, 2 m away 4 mm; five times
    check(result, rig, 0.6, 0.03)


@pytest.mark.parametrize("colour_only", ["C1", "C2", "C3"])
def test_a_camera_without_depth(colour_only):
    rig, rng = arc(3), np.random.default_rng(1)
    with_depth = [name for name in rig.cameras if name != colour_only]
    result = initialize(observe(rig, volume(rng), rng, depths=with_depth), LENSES, "C1")
    assert {s.method for s in result.steps} == {"dlt"}
    check(result, rig, 0.6, 0.03)


def test_over_the_graph_of_pairs_most_features_first():
    rig, rng = arc(4), np.random.default_rng(2)
    points = volume(rng, 90)
    who = {"C1": range(30), "C2": range(60, 90), "C3": [*range(20), *range(60, 90)], "C4": range(10, 30)}
    result = initialize(observe(rig, points, rng, who=who), LENSES, "C1")
    # C2 shares nothing with C1 or C4; C3 and C4 share 20 each with C1, and C2 30 with C3
    assert [(s.camera, s.from_camera, s.points) for s in result.steps] == [
        ("C3", "C1", 20),
        ("C2", "C3", 30),
        ("C4", "C1", 20),
    ]
    check(result, rig, 2.0, 0.08)


def test_any_reference():
    rig, rng = arc(3), np.random.default_rng(3)
    result = initialize(observe(rig, volume(rng), rng), LENSES, "C3")
    np.testing.assert_array_equal(result.T_world_color["C3"], np.eye(4))
    back = se3.inverse(result.T_world_color["C1"])
    check(replace(result, T_world_color={n: back @ T for n, T in result.T_world_color.items()}), rig, 0.6, 0.03)


def test_not_connected_names_the_groups_and_the_pair():
    rig, rng = arc(4), np.random.default_rng(4)
    who = {"C1": range(40), "C2": range(40), "C3": range(38, 80), "C4": range(40, 80)}
    with pytest.raises(
        CalibrationError,
        match=r"not connected: \{C1, C2\} and \{C3, C4\} share at most 2 .* 4 needed\. Film C1 and C3 together",
    ):
        initialize(observe(rig, volume(rng), rng, who=who), LENSES, "C1")


def test_pixels_alone_cannot_start():
    rig, rng = arc(2), np.random.default_rng(5)
    with pytest.raises(CalibrationError, match=r"share at most 0 feature\(s\) with depth"):
        initialize(observe(rig, volume(rng), rng, depths=()), LENSES, "C1")


@pytest.mark.parametrize("pixels", [None, ()], ids=["pixels", "bare points"])
def test_collinear_points_are_refused_with_the_pair(pixels):
    rig, rng = arc(2), np.random.default_rng(6)
    line = np.linspace([-0.3, 0, 2.0], [0.3, 0.1, 2.2], 30)
    with pytest.raises(CalibrationError, match=r"^C1 and C2: .*collinear.*\. Use"):
        initialize(observe(rig, line, rng, 0.01, 0.0002, pixels=pixels), LENSES, "C1")


def test_random_rigs_of_the_refinement_tests():
    data, lenses, _, truth = make(np.random.default_rng(7), points=(0, 100), sigmas=(1.0, 0.003))
    T = initialize(data, lenses, "C1").T_world_color
    for name, expected in truth.items():
        assert np.linalg.norm(se3.difference(T[name], expected)) < 0.01, name

"""Causes that the self-checks tell apart: a moved board from a lens, slips of the tape from an offset or a factor."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.trust.self_check import SelfCheckParams
from rgbd_calib.trust.self_check import motion as motion_check
from rgbd_calib.trust.self_check.findings import Finding
from rgbd_calib.trust.self_check.motion import check_motion
from rgbd_calib.trust.self_check.outcomes import Outcome, findings_of
from rgbd_calib.trust.self_check.walls import WallDistances, check_bends, check_walls

TRUE_M = np.linspace(0.6, 4.0, 10)


def told(*written_m: np.ndarray) -> list[str]:
    walls = {f"C{k + 1}": WallDistances(w, TRUE_M, np.full(10, 0.003)) for k, w in enumerate(written_m)}
    return [f.text for f in check_walls(walls, SelfCheckParams())]


def test_distances_as_tapes_are_say_nothing():
    rng = np.random.default_rng(0)
    assert told(*(TRUE_M + rng.normal(0, 0.003, (3, 10)))) == []  # 8 sigma: 1e-15 each


@pytest.mark.parametrize(
    ("written_m", "says"),
    [
        (
            TRUE_M + 0.05,
            "C1, C2: written distances of walls differ from those by the boards, by 50 mm (RMS): all are +50 mm off",
        ),
        (TRUE_M * 1.03, "they are 1.030 times as long"),
        (TRUE_M + 0.04 * np.sin(9 * TRUE_M), "by the boards, by "),
        (np.where(np.arange(10) == 3, 2.1, TRUE_M), "that the boards contradict: 2.100 m for 1.733 m"),
    ],
)
def test_what_walls_are_off_by_is_said_once(written_m, says):
    (text,) = told(written_m, written_m)
    assert says in text


@pytest.mark.parametrize(("left", "moved"), [(1.3, False), (20.0, True)])
def test_a_lens_is_the_cause_only_if_it_leaves_views_that_agree(monkeypatch, left, moved):
    before = SimpleNamespace(cameras=("C1", "C2"), camera=np.array([0, 1]), size=(300.0, 2000.0))
    after = SimpleNamespace(cameras=("C1", "C2"), camera=np.array([0, 1]), size=(left, left))

    def residuals(eq):
        return np.tile(np.array(eq.size)[:, None], 9), np.ones((2, 9))

    monkeypatch.setattr(motion_check, "pose_residuals", residuals)
    lens = Finding("pixels over the image", "distrust", ("C2",), "a lens", "look")
    found = check_motion(before, after, {"C1": 7.0, "C2": 19.0}, [lens], SelfCheckParams())
    assert [f.cameras for f in found] == ([("C2",)] if moved else [])
    assert check_motion(before, after, {}, [], SelfCheckParams()) == []


def test_walls_that_look_more_bent_than_walls_are_name_their_camera():
    """8 mm for each metre at 45 degrees: the walls of another camera; 0.3 and 3 mm are structured light and time of flight."""
    lens = Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5)
    setup = SimpleNamespace(
        walls=SimpleNamespace(camera=np.array([0, 0, 1, 2])), priors=[SimpleNamespace(intrinsics=lens)] * 3
    )
    problem = SimpleNamespace(setup=setup, weights=SimpleNamespace(wall_bend=np.array([0.0003, 0.008, 0.003])))
    solved = SimpleNamespace(problem=problem, cameras=("C1", "C2", "C3"))
    (found,) = check_bends(solved, SelfCheckParams())
    assert found.cameras == ("C2",) and found.level == "caution"
    assert "C2's walls look bent by the depth, by 7 mm" in found.text  # 8 mm times 2 m times (320 / 500)^2


RATIOS = {"C1": 180.0, "C2": 1124.0, "C3": 136.0}
"""Of a simulated rig whose second camera's image centre moved by 3 px from frame to frame."""


@pytest.mark.parametrize(
    ("ratios", "apart_mm", "named"),
    [
        (RATIOS, 10.7, True),
        (RATIOS, 1.0, False),
        ({"C1": 36.4, "C2": 37.6, "C3": 48.6}, 10.7, False),
        ({"C1": 180.0, "C2": 1124.0}, 10.7, False),
    ],
    ids=["shaken", "small", "all alike", "two cameras"],
)
def test_a_camera_that_shakes_by_itself_is_named(monkeypatch, ratios, apart_mm, named):
    monkeypatch.setattr(
        motion_check, "_ratios", lambda eq, camera=None: ratios[camera] if camera else max(ratios.values())
    )
    eq = SimpleNamespace(cameras=tuple(ratios))
    found = check_motion(eq, eq, dict.fromkeys(ratios, apart_mm), [], SelfCheckParams())
    assert [f.cameras for f in found] == ([("C2",)] if named else [])
    assert all("image stabilisation" in f.advice and "11 mm" in f.text for f in found)


@pytest.mark.parametrize(
    ("name", "p", "level"),
    [("scale", 3e-4, "caution"), ("scale", 1e-7, "distrust"), ("scale", 2e-3, None), ("image", 3e-4, None)],
)
def test_the_boards_size_has_a_significance_of_its_own(name, p, level):
    score = SimpleNamespace(p=p, effect_m=0.02, statistic=13.0, dof=1, plain=13.0, covariance=np.eye(1))
    fault = SimpleNamespace(advice="Measure the print")
    own = {"name": name, "cameras": (), "accepted": lambda eq: eq, "say": lambda eq, s: "text", "fault": fault}
    others = [Outcome(_Hashed(name="other"), SimpleNamespace(p=0.5, effect_m=0.02, covariance=np.eye(1)))] * 75
    tests = [Outcome(_Hashed(**own), score), *others]
    found, _ = findings_of(None, tests, SelfCheckParams(), 2.0)
    assert [f.level for f in found] == ([] if level is None else [level])


class _Hashed(SimpleNamespace):
    __hash__ = object.__hash__

"""Clouds of two cameras against each other: is the distance that of the calibration, without the noise?"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from rgbd_calib.cli.options import progress
from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.rig import read_rig, write_rig
from rgbd_calib.simulation.changes import SceneChange
from rgbd_calib.simulation.params import SimulationParams
from rgbd_calib.simulation.snapshot import simulate_snapshots
from rgbd_calib.trust.snapshot.clouds import cloud_gap
from rgbd_calib.trust.snapshot.surfaces import Surface
from rgbd_calib.types import RigCamera

LENS = Intrinsics(240, 180, 200.0, 200.0, 119.5, 89.5, (0.0, 0.0, 0.0, 0.0, 0.0))
CAMERA = RigCamera(LENS, np.eye(4), np.zeros((6, 6)))


def wall(T_color_world, noise_m=0.0, rng=None) -> Surface:
    """The plane z = 2 of the world, as a camera sees it."""
    v, u = np.mgrid[: LENS.height, : LENS.width].astype(float)
    normal = T_color_world[:3, :3] @ [0, 0, 1.0]
    z = (2.0 + normal @ T_color_world[:3, 3]) / (LENS.rays(np.stack([u, v], axis=-1)) @ normal)
    return Surface(CAMERA, z if rng is None else z + noise_m * rng.standard_normal(z.shape))


@pytest.mark.parametrize("off_mm", [0.0, 2.0])
def test_the_noise_is_taken_off(off_mm):
    rng = np.random.default_rng(3)
    T_world_b = se3.retract(np.eye(4), np.array([0, -0.2, 0, 0.4, 0, 0]))
    a, b = wall(np.eye(4), 0.01, rng), wall(se3.inverse(T_world_b), 0.01, rng)
    wrong = T_world_b.copy()
    wrong[2, 3] += off_mm / 1e3
    gap = cloud_gap(a, b, wrong)
    assert gap.share > 0.5
    rms_mm = 1e3 * np.sqrt(np.mean(gap.distance_m**2))
    # 81 pixels a patch, two cameras: 1.6 mm of noise; its products have that squared as deviation, and some 300 of them
    sd_mm2 = (np.sqrt(2) * 10 / 9) ** 2 / np.sqrt(len(gap.products_m2) / 2)
    assert rms_mm > 1.2
    assert (1e3 * gap.error_m) ** 2 == pytest.approx(off_mm**2, abs=5 * sd_mm2 + 4 * off_mm * 1.6 / np.sqrt(150))


def test_opposite_faces_and_hidden_surfaces_are_not_compared():
    behind = se3.make(np.diag([-1.0, 1.0, -1.0]), np.array([0, 0, 4.0]))
    assert len(cloud_gap(wall(np.eye(4)), wall(se3.inverse(behind)), behind).distance_m) == 0
    far = se3.retract(np.eye(4), np.array([0, 0, 0, 0, 0, 0.3]))  # by the rig b's wall stands 30 cm behind a's
    assert len(cloud_gap(wall(np.eye(4)), wall(np.eye(4)), far).distance_m) == 0


def test_evaluate_clouds_sees_a_camera_that_stands_wrong(run, tmp_path):
    simulate_snapshots(
        tmp_path, SimulationParams(cameras=2, width=240, height=180, seed=6), SceneChange(), 4, 1, progress
    )  # fmt: skip
    rig = read_rig(tmp_path / "truth.yaml")
    moved = replace(rig.cameras["C2"], T_world_color=rig.cameras["C2"].T_world_color.copy())
    moved.T_world_color[:3, 3] += [0.0, 0.0, 0.015]
    write_rig(tmp_path / "wrong.yaml", replace(rig, cameras=rig.cameras | {"C2": moved}))
    errors = {}
    for name in ("truth", "wrong"):
        result = run("evaluate", tmp_path / f"{name}.yaml", "--clouds", tmp_path / "old", "--json")
        assert result.status == 0, result.stderr
        errors[name] = json.loads(result.stdout)["pairs"]["C1 - C2"]["error_mm"]
    assert errors["truth"] < 4 < errors["wrong"] < 15
    text = run("evaluate", tmp_path / "truth.yaml", "--clouds", tmp_path / "old")
    assert "C1 - C2: " in text.stdout and "all pairs" in text.stdout
    assert run("evaluate", tmp_path / "truth.yaml", "--clouds", "x", "--truth", "y").status == 2

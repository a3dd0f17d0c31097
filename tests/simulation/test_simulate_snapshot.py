"""Simulated snapshots: is the truth what the images were made with?"""

from __future__ import annotations

import numpy as np
import pytest

from rgbd_calib.cli.options import progress
from rgbd_calib.geometry import se3
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_rig
from rgbd_calib.simulation.changes import SceneChange, scenes
from rgbd_calib.simulation.color_sensor import ColorNoise
from rgbd_calib.simulation.depth_sensor import DepthNoise
from rgbd_calib.simulation.params import SimulationParams
from rgbd_calib.simulation.recording import true_rig_of
from rgbd_calib.simulation.scene import Caster
from rgbd_calib.simulation.snapshot import changed_share, simulate_snapshots
from rgbd_calib.simulation.surfaces import see_room
from rgbd_calib.simulation.view import View

SMALL = ["--cameras", "2", "--width", "160", "--height", "120", "--no-noise", "--jobs", "1", "--depth-frames", "2"]


MOVED = np.concatenate([np.radians([0, 1.5, 0]), [0.020, 0, -0.010]])


@pytest.fixture(scope="module")
def bumped(tmp_path_factory):
    out = tmp_path_factory.mktemp("snapshot")
    exact = ColorNoise(0.0, 0.0), DepthNoise(ideal=True)
    params = SimulationParams(cameras=2, width=160, height=120, color_noise=exact[0], depth_noise=exact[1], bias=False)
    simulate_snapshots(out, params, SceneChange({"C2": MOVED}, objects=2), 2, 1, progress)
    return out


def test_the_truth_maps_new_points_onto_the_old_scene(bumped):
    truth = read_rig(bumped / "truth.yaml")
    T_old_new = np.array(truth.quality.snapshot.T_old_new["C2"])
    assert np.allclose(T_old_new[:3, 3], [0.020, 0, -0.010])
    assert np.degrees(np.arccos((np.trace(T_old_new[:3, :3]) - 1) / 2)) == pytest.approx(1.5)
    old, new = (open_recording(bumped / state) for state in ("old", "new"))
    lens = truth.cameras["C2"].depth_sensor
    points = [lens_points(lens, recording.depth_m("C2", "000000")) for recording in (old, new)]
    sizes = []
    for T in (T_old_new, np.eye(4)):
        there = se3.transform(T, points[1])
        px = np.rint(lens.camera.intrinsics.project(there)).astype(int)
        ok = np.all((px >= 0) & (px < [160, 120]), axis=1)
        seen = old.depth_m("C2", "000000")[px[ok, 1], px[ok, 0]]
        sizes.append(np.nanmedian(np.abs(seen - there[ok, 2])))
    # half a pixel is 9 mm at 2.5 m, and so in depth on a surface at 45 degrees
    assert sizes[0] < 0.009 < sizes[1] / 2


def lens_points(sensor, depth_m):
    v, u = np.nonzero(np.isfinite(depth_m))
    return sensor.points(np.stack([u, v], axis=1).astype(float), depth_m[v, u])


def test_the_rig_is_that_of_the_same_seed_and_what_stayed_is_said(bumped):
    truth = read_rig(bumped / "truth.yaml")
    assert truth.quality.snapshot.moved == ("C2",)
    assert 0 <= truth.quality.snapshot.changed_share["C1"] < 0.5
    same = true_rig_of(SimulationParams(cameras=2, width=160, height=120, bias=False)).intrinsics["C1"]
    assert np.allclose(truth.cameras["C1"].intrinsics.vector, same.vector)


def test_people_and_furniture_change_what_they_hide():
    rig = true_rig_of(SimulationParams(cameras=2, width=160, height=120))
    for change in (SceneChange(people=3), SceneChange(objects=14)):
        old, new = scenes(change, np.random.default_rng(0))
        assert 0.02 < changed_share(rig, "C1", {"old": old, "new": new}) < 0.9
    old, new = scenes(SceneChange(), np.random.default_rng(0))
    assert changed_share(rig, "C1", {"old": old, "new": new}) == 0


def test_a_wall_is_a_plane():
    rig = true_rig_of(SimulationParams(cameras=2, width=160, height=120))
    wall, _ = scenes(SceneChange(surroundings="wall"), np.random.default_rng(0))
    view = View(rig.intrinsics["C1"], rig.T_room_color["C1"])
    z_m = see_room(view, Caster(wall))[0]
    points = view.origin_m + z_m.reshape(-1, 1) * view.centres
    assert np.ptp(points[:, 1]) < 1e-9


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--move", "C2:1,2,3,0,0,0"], "need --snapshot"),
        (["--snapshot", "--move", "C9:1,2,3,0,0,0"], "with a camera of C1, C2"),
        (["--snapshot", "--move", "C2:1,2,3"], "6 finite numbers"),
        (["--snapshot", "--warm-up", "1"], "2 finite numbers"),
    ],
)
def test_wrong_options_are_refused(run, tmp_path, options, words):
    result = run("simulate", tmp_path / "x", *options, *SMALL)
    assert result.status == 2 and words in result.stderr


def test_the_command_writes_both_snapshots(run, tmp_path):
    result = run("simulate", tmp_path / "x", "--snapshot", "--move", "C2:20,0,-10,0,1.5,0", "--light", "0.5", *SMALL)
    assert result.status == 0 and "changed: C1 0 %" in result.stderr
    truth = read_rig(tmp_path / "x" / "truth.yaml").quality.snapshot
    assert np.allclose(truth.T_old_new["C2"], se3.retract(np.eye(4), MOVED))
    for state in ("old", "new"):
        assert len(open_recording(tmp_path / "x" / state).depth_files["C2"]) == 2

"""Poses refined by clouds: is the covariance that of the error, and is a rig refused that would not become better?"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from rgbd_calib.geometry import se3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.depth_error import DepthBias
from rgbd_calib.io.recording import CameraInfo, open_recording, save_color, save_depth, write_dataset
from rgbd_calib.io.rig import read_rig, write_rig
from rgbd_calib.pipeline.clouds import surfaces_of
from rgbd_calib.pipeline.details import expectation
from rgbd_calib.pipeline.evaluate import volume_corners
from rgbd_calib.pipeline.world import moved_rig
from rgbd_calib.quality import Quality
from rgbd_calib.trust.snapshot.cloud_fusion import fuse_clouds
from rgbd_calib.trust.snapshot.clouds import GATE_M
from rgbd_calib.trust.snapshot.determined import free_directions
from rgbd_calib.trust.snapshot.surfaces import Surface
from rgbd_calib.trust.uncertainty import JointCovariance
from rgbd_calib.types import Rig, RigCamera

LENS = Intrinsics(160, 120, 140.0, 140.0, 79.5, 59.5, (0.0, 0.0, 0.0, 0.0, 0.0))
K_PER_M = 3e-4
CORNER = np.array([[0.0, 0.0, 1.0, 2.6], [0.6, 0.0, 0.8, 2.4], [-0.5, 0.1, 0.86, 2.3], [0.0, -0.8, 0.6, 1.9]])
"""Planes n . p = d, the nearest of which is seen."""
POSES = {
    "C1": np.eye(4),
    "C2": se3.retract(np.eye(4), np.array([0, -0.2, 0, 0.5, 0, 0])),
    "C3": se3.retract(np.eye(4), np.array([0.1, 0.2, 0, -0.5, 0.1, 0])),
}
BIAS_SD = np.array([0.002, 0.001])
POSE_SD = np.repeat([0.002, 0.004], 3)


def depth(T_world_color, planes) -> np.ndarray:
    v, u = np.mgrid[: LENS.height, : LENS.width].astype(float)
    rays = LENS.rays(np.stack([u, v], axis=-1)) @ T_world_color[:3, :3].T
    with np.errstate(divide="ignore"):
        z = (planes[:, 3] - planes[:, :3] @ T_world_color[:3, 3]) / (rays @ planes[:, :3].T)
    return np.where(z > 0, z, np.inf).min(axis=-1)


def rig_at(poses, joint: JointCovariance) -> Rig:
    cameras = {}
    for name, T in poses.items():
        at, bias_at = joint.parameters[name]["pose"], joint.parameters[name]["depth bias"]
        bias = DepthBias((0.0, 0.0), 0.3, 4.0, 0.0, joint.matrix[np.ix_(bias_at, bias_at)])
        cameras[name] = RigCamera(LENS, T, joint.matrix[np.ix_(at, at)], bias)
    return Rig("C1", cameras)


def joint_of(names, rng=None, pose_sd=POSE_SD) -> JointCovariance:
    """With a generator, all parameters are correlated."""
    parameters = {
        n: {"pose": np.arange(8 * i, 8 * i + 6), "depth bias": np.arange(8 * i + 6, 8 * i + 8)}
        for i, n in enumerate(names)
    }
    sd = np.tile(np.concatenate([pose_sd, BIAS_SD]), len(names))
    sd[:6] = 0
    R = np.eye(len(sd))
    if rng is not None:
        mixed = np.eye(len(sd)) + 0.3 * rng.standard_normal(R.shape)
        C = mixed @ mixed.T
        R = C / np.sqrt(np.outer(np.diag(C), np.diag(C)))
    return JointCovariance(R * np.outer(sd, sd), parameters)


def seen(true_poses, planes, errors, rng) -> dict[str, np.ndarray]:
    """Depth as measured: with the offset and slope by camera that `errors` says is to be added, and noise."""
    out = {}
    for name, T in true_poses.items():
        z = depth(T, planes)
        z = (z - errors[name][0]) / (1 + errors[name][1])
        out[name] = z + K_PER_M * z**2 * rng.standard_normal(z.shape)
    return out


def test_the_covariance_is_that_of_the_error():
    rng = np.random.default_rng(8)
    joint = joint_of(POSES, rng)
    root = np.linalg.cholesky(joint.matrix + 1e-18 * np.eye(len(joint.matrix)))
    rig = rig_at(POSES, joint)
    of_pose = np.concatenate([own["pose"] for own in joint.parameters.values()])[6:]
    nees, surprise = [], []
    for _ in range(15):
        theta = root @ rng.standard_normal(len(root))  # what is to be added to the rig's parameters
        true = {n: se3.retract(T, theta[joint.parameters[n]["pose"]]) for n, T in POSES.items()}
        measured = seen(true, CORNER, {n: theta[own["depth bias"]] for n, own in joint.parameters.items()}, rng)
        found = fuse_clouds(rig, joint, [{n: Surface(rig.cameras[n], z) for n, z in measured.items()}])
        e = np.concatenate([se3.difference(true[n], found.rig.cameras[n].T_world_color) for n in POSES])[6:]
        nees.append(e @ np.linalg.solve(found.joint.matrix[np.ix_(of_pose, of_pose)], e))
        surprise.append(found.surprise)
        before, after = (np.sqrt(np.trace(j.matrix[np.ix_(of_pose, of_pose)])) for j in (joint, found.joint))
        assert after < 0.8 * before
    # 12 unknowns, 15 draws, at 0.001 each side; where the surprise is above 1 by chance, the covariance is larger
    low, high = stats.chi2.ppf([0.001, 0.999], 12 * 15) / 15
    assert low / np.mean(np.maximum(surprise, 1)) < np.mean(nees) < high
    assert 0.6 < np.mean(surprise) < 1.5
    bias_at = joint.parameters["C2"]["depth bias"]  # it stays, and what is known of it
    scale = max(surprise[-1], 1.0)
    np.testing.assert_allclose(
        found.joint.matrix[np.ix_(bias_at, bias_at)], scale * joint.matrix[np.ix_(bias_at, bias_at)]
    )
    assert found.rig.cameras["C2"].depth_bias == rig.cameras["C2"].depth_bias


def test_a_wall_leaves_a_camera_free_along_it():
    rng, two = np.random.default_rng(1), {n: POSES[n] for n in ("C1", "C2")}
    joint = joint_of(two)
    rig = rig_at(two, joint)
    none = dict.fromkeys(two, (0.0, 0.0))
    wall = [{n: Surface(rig.cameras[n], z) for n, z in seen(two, CORNER[:1], none, rng).items()}]
    found = fuse_clouds(rig, joint, wall)
    free = free_directions(found.by_clouds["C2"], 2.0, GATE_M)
    text = " ".join(free)
    assert len(free) == 3
    assert all(word in text for word in ("roll", "sideways", "vertical")) and "forward" not in text
    room = [{n: Surface(rig.cameras[n], z) for n, z in seen(two, CORNER, none, rng).items()}]
    assert not free_directions(fuse_clouds(rig, joint, room).by_clouds["C2"], 2.0, GATE_M)


def test_surfaces_seen_from_opposite_sides_say_nothing():
    behind = {"C1": np.eye(4), "C2": se3.make(np.diag([-1.0, 1.0, -1.0]), np.array([0, 0, 5.2]))}
    joint = joint_of(behind)
    rig = rig_at(behind, joint)
    assert (
        fuse_clouds(rig, joint, [{n: Surface(rig.cameras[n], depth(T, CORNER[:1])) for n, T in behind.items()}]) is None
    )


def test_a_joint_covariance_is_kept_in_a_rig_file(tmp_path):
    joint = joint_of(POSES, np.random.default_rng(2))
    rig = rig_at(POSES, joint)
    expected = expectation(rig, joint, volume_corners(rig), list(POSES))
    write_rig(tmp_path / "rig.yaml", replace(rig, quality=Quality(expected_alignment=expected)))
    read = read_rig(tmp_path / "rig.yaml")
    back = JointCovariance.of_kept(read.quality.expected_alignment.joint)
    sd = np.sqrt(np.maximum(np.diag(joint.matrix), 1e-30))
    # half floats: 5e-4 of a number, and rows of some ten of them
    assert np.abs((back.matrix - joint.matrix) / np.outer(sd, sd)).max() < 2e-3
    T = se3.retract(np.eye(4), np.array([0.3, -1.0, 0.2, 1.0, 2.0, 0.5]))
    moved = moved_rig(read, T, "C2", None)
    there = JointCovariance.of_kept(moved.quality.expected_alignment.joint)
    at = there.parameters["C3"]["pose"]
    own = moved.cameras["C3"].covariance
    sd = np.sqrt(np.diag(own))
    assert np.abs((there.matrix[np.ix_(at, at)] - own) / np.outer(sd, sd)).max() < 4e-3
    with pytest.raises(ValueError, match="for 24 parameters"):
        JointCovariance.of_kept(replace(expected.joint, sd=expected.joint.sd[:-1]))
    with pytest.raises(ValueError, match="a pose of 6"):
        JointCovariance.of_kept(replace(expected.joint, sizes={n: {"intrinsics": 8} for n in POSES}))


def recorded(folder, measured):
    for name, z in measured.items():
        save_color(folder, name, "000000", np.full((LENS.height, LENS.width, 3), 90, np.uint8))
        save_depth(folder, name, "000000", np.rint(z / 2.5e-4).astype(np.uint16))
    write_dataset(
        folder, {n: CameraInfo(LENS.width, LENS.height, depth_scale=2.5e-4, depth_stated=True) for n in measured}, None
    )


def test_all_depth_images_of_a_still_scene_count(tmp_path):
    """Snapshots have one colour image and many in depth."""
    recorded(tmp_path / "scene", {"C1": np.full((LENS.height, LENS.width), 2.0)})
    for k in (1, 2, 3):
        save_depth(tmp_path / "scene", "C1", f"{k:06d}", np.full((LENS.height, LENS.width), 8000 + 4 * k, np.uint16))
    rig = Rig("C1", {"C1": RigCamera(LENS, np.eye(4), np.zeros((6, 6)))})
    opened = open_recording(tmp_path / "scene")
    means = [next(surfaces_of(opened, rig, left))["C1"].points_m[..., 2].mean() for left in ((), ("000000", "000001"))]
    assert means == pytest.approx([2.0015, 2.0025], abs=1e-6)


def stated(path, poses, joint):
    rig = rig_at(poses, joint)
    expected = expectation(rig, joint, volume_corners(rig), list(poses))
    write_rig(path, replace(rig, quality=Quality(expected_alignment=expected)))
    return expected


def test_refine_writes_a_better_rig_and_refuses_another(run, tmp_path):
    rng = np.random.default_rng(5)
    recorded(tmp_path / "scene", seen(POSES, CORNER, dict.fromkeys(POSES, (0.0, 0.0)), rng))
    off = {n: T if n == "C1" else se3.retract(T, 1.5 * POSE_SD * rng.choice([-1, 1], 6)) for n, T in POSES.items()}
    command = "refine", tmp_path / "weak.yaml", "--clouds", tmp_path / "scene", "-o", tmp_path / "out.yaml"
    before = stated(tmp_path / "weak.yaml", off, joint_of(POSES, pose_sd=2 * POSE_SD))
    result = run(*command, "--json")
    assert result.status == 0, result.stderr
    numbers, out = json.loads(result.stdout), read_rig(tmp_path / "out.yaml")
    assert numbers["refused"] == [] and numbers["expected_after_mm"] < 0.7 * numbers["expected_before_mm"]
    assert numbers["expected_before_mm"] == pytest.approx(before.mean_mm, rel=0.01)
    assert out.quality.expected_mm == numbers["expected_after_mm"]
    assert [own.by for own in out.quality.updates] == ["clouds"] * 3 and out.provenance["updates"][0]["by"] == "clouds"
    for name in ("C2", "C3"):
        errors = [se3.difference(T, POSES[name]) for T in (off[name], out.cameras[name].T_world_color)]
        assert errors[1] @ np.linalg.solve(out.cameras[name].covariance, errors[1]) < stats.chi2.ppf(0.999, 6)
        assert out.cameras[name].depth_bias.coefficients == (0.0, 0.0)

    stated(tmp_path / "good.yaml", POSES, joint_of(POSES, pose_sd=0.05 * POSE_SD))
    command = "refine", tmp_path / "good.yaml", "--clouds", tmp_path / "scene", "-o", tmp_path / "kept.yaml"
    result = run(*command)
    assert result.status == 1 and "the clouds add nothing" in result.stderr and not (tmp_path / "kept.yaml").exists()
    assert run(*command, "--force").status == 0 and (tmp_path / "kept.yaml").exists()

    off = {n: T if n == "C1" else se3.retract(T, 5 * POSE_SD * rng.choice([-1, 1], 6)) for n, T in POSES.items()}
    stated(tmp_path / "bumped.yaml", off, joint_of(POSES, pose_sd=0.1 * POSE_SD))
    command = "refine", tmp_path / "bumped.yaml", "--clouds", tmp_path / "scene", "-o", tmp_path / "mended.yaml"
    result = run(*command)
    assert result.status == 1 and "standard deviations apart" in result.stderr
    result = run(*command, "--pose-sd", 30)
    assert result.status == 0, result.stderr


def test_a_rig_without_covariance_needs_one_stated(run, tmp_path):
    rng = np.random.default_rng(6)
    recorded(tmp_path / "scene", seen(POSES, CORNER[:1], dict.fromkeys(POSES, (0.0, 0.0)), rng))
    bare = Rig("C1", {name: RigCamera(LENS, T, np.zeros((6, 6))) for name, T in POSES.items()})
    write_rig(tmp_path / "bare.yaml", bare)
    command = "refine", tmp_path / "bare.yaml", "--clouds", tmp_path / "scene", "-o", tmp_path / "out.yaml"
    result = run(*command)
    assert result.status == 1 and "--pose-sd MM" in result.stderr
    result = run(*command, "--pose-sd", 5)
    assert result.status == 1 and "the scene leaves cameras free: C2 (" in result.stderr
    assert run(*command, "--intrinsics", "x").status == 2
    assert run("refine", "c.csv", "-o", tmp_path / "x.yaml").status == 2
    assert run("refine", "c.csv", "--intrinsics", "x", "--force", "-o", tmp_path / "x.yaml").status == 2


def test_cameras_that_share_no_surface_stay(run, tmp_path):
    rng = np.random.default_rng(7)
    apart = POSES | {"C3": se3.retract(np.eye(4), np.array([0, np.pi, 0, 0, 0, 0]))}
    measured = seen({n: apart[n] for n in ("C1", "C2")}, CORNER, dict.fromkeys(apart, (0.0, 0.0)), rng)
    measured["C3"] = np.full((LENS.height, LENS.width), 2.0)
    recorded(tmp_path / "scene", measured)
    stated(tmp_path / "rig.yaml", apart, joint_of(apart, pose_sd=2 * POSE_SD))
    result = run("refine", tmp_path / "rig.yaml", "--clouds", tmp_path / "scene", "-o", tmp_path / "out.yaml", "--json")
    assert result.status == 0, result.stderr
    numbers = json.loads(result.stdout)
    assert numbers["no_surface_in_common"] == ["C3"] and [*numbers["patches"]] == ["C1 - C2"]
    np.testing.assert_allclose(read_rig(tmp_path / "out.yaml").cameras["C3"].T_world_color, apart["C3"], atol=1e-9)
    again = read_rig(tmp_path / "rig.yaml")
    images = open_recording(tmp_path / "scene").image_digests()
    write_rig(tmp_path / "own.yaml", replace(again, provenance={"images_sha256": images}))
    result = run("refine", tmp_path / "own.yaml", "--clouds", tmp_path / "scene", "-o", tmp_path / "own2.yaml")
    assert result.status == 2 and "were used to calibrate this rig" in result.stderr

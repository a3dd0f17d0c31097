"""Corrected recordings: depth is true, lenses are pinholes, nothing else has changed."""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics, project, unproject
from rgbd_calib.io.files import dump_yaml, load_yaml
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_rig, write_rig
from rgbd_calib.pipeline.correct import correct_depth, undistort_map
from rgbd_calib.pipeline.fuse import FuseParams, clouds_of
from rgbd_calib.types import DepthBias, DepthCamera, RigCamera


def corrected(run, tiny, out, *more):
    outcome = run("correct", tiny.recording, "--rig", tiny.rig_path, "-o", out, *more)
    assert outcome.status == 0, outcome.stderr
    return outcome


def test_depth_is_what_the_bias_says_to_half_a_unit(run, tiny, tmp_path):
    outcome = corrected(run, tiny, tmp_path / "out")
    assert "C3: 2 colour, 0 depth images" in outcome.stderr
    before, after = open_recording(tiny.recording), open_recording(tmp_path / "out")
    assert after.frames == before.frames and after.extra["notes"] == "kept"
    for camera in ("C1", "C2"):
        assert list(after.depth_files[camera]) == list(before.depth_files[camera])
        for frame in before.depth_files[camera]:
            wanted_m = tiny.rig.cameras[camera].depth_bias.correct(before.depth_m(camera, frame))
            # units of 0.5 mm, rounded
            assert np.abs(after.depth_m(camera, frame) - wanted_m).max() <= 0.00025 + 1e-12
    for camera, files in before.color_files.items():
        for frame, path in files.items():
            assert after.color_files[camera][frame].read_bytes() == path.read_bytes()
        assert after.cameras[camera].intrinsics == tiny.rig.cameras[camera].intrinsics


def test_floating_point_depth_becomes_millimetres(run, tiny, tmp_path):
    """Of a recording whose depth is TIFF in metres: its unit of 1 m would be too coarse for 16 bits."""
    folder = tmp_path / "recording"
    shutil.copytree(tiny.recording, folder)
    original = open_recording(tiny.recording)
    for camera in ("C1", "C2"):
        for frame, path in open_recording(folder).depth_files[camera].items():
            depth_m = np.nan_to_num(original.depth_m(camera, frame)).astype(np.float32)
            cv2.imwrite(str(path.with_suffix(".tiff")), depth_m)
            path.unlink()
    data = load_yaml(folder / "dataset.yaml")
    data.pop("depth_scale", None)
    for camera in ("C1", "C2"):
        data["cameras"][camera].pop("depth_scale", None)
        data["cameras"][camera]["depth"] = {"scale_m": 1.0}
    (folder / "dataset.yaml").write_text(dump_yaml(data))
    outcome = run("correct", folder, "--rig", tiny.rig_path, "-o", tmp_path / "out")
    assert outcome.status == 0, outcome.stderr
    after = open_recording(tmp_path / "out")
    assert after.cameras["C1"].depth_scale == 0.001
    wanted_m = tiny.rig.cameras["C1"].depth_bias.correct(original.depth_m("C1", "000000"))
    # rounded to millimetres before and after the correction
    assert np.nanmax(np.abs(after.depth_m("C1", "000000") - wanted_m)) <= 0.0011


def test_the_rig_beside_it_gives_the_same_cloud(run, tiny, tmp_path):
    corrected(run, tiny, tmp_path / "out")
    args = "000000", FuseParams(jump=np.inf)
    before = clouds_of(open_recording(tiny.recording), tiny.rig, *args)
    after = clouds_of(open_recording(tmp_path / "out"), read_rig(tmp_path / "out" / "rig.yaml"), *args)
    for a, b in zip(before, after, strict=True):
        assert np.abs(a.points_m - b.points_m).max() < 0.00025 * 1.2 + 1e-9  # half a unit along the longest ray


@pytest.fixture
def unregistered(tiny, tmp_path):
    """The tiny recording, its depth that of a camera with another lens, beside the colour camera; and its rig."""
    shutil.copytree(tiny.recording, tmp_path / "own")
    lens = Intrinsics(64, 48, 58.0, 58.5, 30.0, 24.5, (0.02, 0.0, 0.0, 0.0, 0.0))
    depth = DepthCamera(lens, se3.make(so3.exp(np.array([0.01, -0.02, 0.0])), np.array([0.03, 0.0, 0.002])))
    rig = read_rig(tiny.rig_path)
    cameras = {n: replace(c, depth_camera=depth if n != "C3" else None) for n, c in rig.cameras.items()}
    write_rig(tmp_path / "own.yaml", replace(rig, cameras=cameras))
    return tmp_path / "own", tmp_path / "own.yaml"


def test_depth_in_its_own_geometry_gives_the_same_cloud(run, unregistered, tmp_path):
    recording, rig_path = unregistered
    common = ("correct", recording, "--rig", rig_path, "-o", tmp_path / "out", "--geometry", "depth")
    assert run(*common, "--undistort").status == 2
    out = run(*common)
    assert out.status == 0, out.stderr
    after, rig = open_recording(tmp_path / "out"), read_rig(tmp_path / "out" / "rig.yaml")
    info = after.cameras["C1"]
    assert info.depth is not None and info.depth.intrinsics == rig.cameras["C1"].depth_camera.intrinsics
    np.testing.assert_allclose(info.depth.T_color_depth, rig.cameras["C1"].depth_camera.T_color_depth, atol=1e-12)
    assert rig.cameras["C1"].depth_bias is None
    args = "000000", FuseParams(jump=np.inf)
    before = clouds_of(open_recording(recording), read_rig(rig_path), *args)
    for a, b in zip(before, clouds_of(after, rig, *args), strict=True):
        assert np.abs(a.points_m - b.points_m).max() < 0.00025 * 1.3 + 1e-9  # half a unit along the longest ray
    again = run("correct", tmp_path / "out", "--rig", rig_path, "-o", tmp_path / "twice")
    assert again.status == 2 and "removed from this recording already" in again.stderr


def test_undistorted_depth_lies_on_the_surface_seen_through_a_pinhole(run, tiny, tmp_path):
    corrected(run, tiny, tmp_path / "out", "--undistort")
    after = open_recording(tmp_path / "out")
    rig = read_rig(tmp_path / "out" / "rig.yaml")
    for camera in ("C1", "C2"):
        lens, T = rig.cameras[camera].intrinsics, rig.cameras[camera].T_world_color
        assert lens.distortion == (0.0,) * 5 and after.cameras[camera].intrinsics == lens
        assert np.array_equal(lens.K, tiny.rig.cameras[camera].intrinsics.K)
        z_m = after.depth_m(camera, "000000")
        v, u = np.nonzero(np.isfinite(z_m))
        keep = u > 20  # C1 sees another plane left of column 16
        pixels = np.stack([u, v], axis=1)[keep].astype(float)
        p_world = se3.transform(T, unproject(lens.vector, pixels, z_m[v, u][keep]))
        off_m = np.abs(p_world @ tiny.normal - tiny.offset_m)
        # the nearest pixel is up to 0.71 px away: at f = 60 px and z < 2.6 m, on a plane whose depth changes by less
        # than 1.0 m a unit of ray for either camera, that is 0.71 / 60 * 2.6 m; half a unit of depth is nothing to it
        assert off_m.max() < 0.71 / 60 * 2.6
        assert np.median(off_m) < 0.01


def test_undistort_map_agrees_with_opencv():
    lens = Intrinsics(320, 240, 280.0, 281.0, 158.2, 121.7, (0.08, -0.15, 0.001, -0.002, 0.06))
    ours = undistort_map(lens)
    u, v = cv2.initUndistortRectifyMap(lens.K, np.array(lens.distortion), None, lens.K, (320, 240), cv2.CV_32FC1)
    assert np.abs(ours.u_px - u).max() < 1e-4 and np.abs(ours.v_px - v).max() < 1e-4  # float32 of 320
    assert ours.valid[120, 160]


def test_pixels_beyond_the_lens_models_turning_point_are_left_empty():
    lens = Intrinsics(200, 200, 60.0, 60.0, 100.0, 100.0, (-0.3, 0.0, 0.0, 0.0, 0.0))
    valid = undistort_map(lens).valid
    u, v = np.meshgrid(np.arange(200.0), np.arange(200.0))
    r = np.hypot(u - 100, v - 100) / 60
    turning = 1 / np.sqrt(0.9)  # d(r - 0.3 r^3) / dr = 0
    assert valid[r < turning - 0.02].all() and not valid[r > turning + 0.02].any()


def test_pixels_that_no_longer_fit_become_zero_and_are_counted():
    lens = Intrinsics(4, 1, 1.0, 1.0, 0.0, 0.0)
    camera = RigCamera(lens, np.eye(4), np.zeros((6, 6)), DepthBias((-0.5, 0.1), 0.6, 60.0, 0.0))
    out, lost, held = correct_depth(np.array([[0, 100, 1000, 65000]], np.uint16), 0.001, camera)
    # 0.1 m: the correction is held at that of 0.6 m, -0.44 m; 65 m: held at that of 60 m, +5.5 m
    assert out.tolist() == [[0, 0, 600, 0]] and (lost, held) == (2, 2)
    out, lost, held = correct_depth(np.array([[0, 100, 1000, 650]], np.uint16), 0.001, camera, within_range=True)
    assert out.tolist() == [[0, 0, 600, 215]] and (lost, held) == (0, 1)


def test_depth_outside_the_range_of_the_bias_is_told_and_can_be_left_out(run, tiny, tmp_path):
    own = {n: replace(c, depth_bias=DepthBias((0.01,), 0.5, 1.2, 0.0)) for n, c in tiny.rig.cameras.items()}
    write_rig(tmp_path / "near.yaml", replace(tiny.rig, cameras=own))
    for name, more, said in (("a", (), "corrected less surely"), ("b", ("--within-range",), "left out")):
        done = run("correct", tiny.recording, "--rig", tmp_path / "near.yaml", "-o", tmp_path / name, *more)
        assert done.status == 0 and "% of the depth pixels outside the range of the bias's data" in done.stderr
        assert said in done.stderr
        fused = run("fuse", tiny.recording, "--rig", tmp_path / "near.yaml", "-o", tmp_path / f"{name}.ply", *more)
        assert "outside the range of the bias's data" in fused.stderr
        assert ("left out" in fused.stderr.split("C2")[1]) == bool(more)
    raw = open_recording(tmp_path / "b").depth_m("C2", "000000")
    assert np.nanmax(raw, initial=0) <= 1.21


def test_a_recording_is_not_corrected_twice(run, tiny, tmp_path):
    corrected(run, tiny, tmp_path / "out")
    again = run("correct", tmp_path / "out", "--rig", tiny.rig_path, "-o", tmp_path / "twice")
    assert again.status == 2 and "already" in again.stderr
    assert not (tmp_path / "twice").exists()
    corrected(run, tiny, tmp_path / "pinhole", "--undistort")
    no_bias = {n: replace(c, depth_bias=None) for n, c in tiny.rig.cameras.items()}
    write_rig(tmp_path / "lens.yaml", replace(tiny.rig, cameras=no_bias))
    fused = run("fuse", tmp_path / "pinhole", "--rig", tmp_path / "lens.yaml", "-o", tmp_path / "a.ply")
    assert fused.status == 2 and "distortion" in fused.stderr


def test_threads_change_nothing(run, tiny, tmp_path):
    for jobs in (1, 3):
        corrected(run, tiny, tmp_path / str(jobs), "--undistort", "--jobs", jobs)
    one = {p.relative_to(tmp_path / "1"): p.read_bytes() for p in (tmp_path / "1").rglob("*") if p.is_file()}
    three = {p.relative_to(tmp_path / "3"): p.read_bytes() for p in (tmp_path / "3").rglob("*") if p.is_file()}
    assert one == three


def test_a_damaged_image_leaves_nothing(run, tiny, tmp_path):
    shutil.copytree(tiny.recording, tmp_path / "in")
    path = tmp_path / "in" / "C2" / "depth" / "000000.png"
    path.write_bytes(path.read_bytes()[:100])
    outcome = run("correct", tmp_path / "in", "--rig", tiny.rig_path, "-o", tmp_path / "out")
    assert outcome.status == 2 and "C2/depth/000000.png: damaged" in outcome.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["in"]


@pytest.mark.parametrize(
    ("where", "why"), [("in", "is also the input"), ("in/out", "lies in the input"), (".", "holds the input")]
)
def test_the_recording_itself_is_never_replaced(run, tiny, tmp_path, where, why):
    shutil.copytree(tiny.recording, tmp_path / "in")
    outcome = run("correct", tmp_path / "in", "--rig", tiny.rig_path, "--overwrite", "-o", tmp_path / where)
    assert outcome.status == 2 and why in outcome.stderr
    assert open_recording(tmp_path / "in").frames == ("000000", "000001")


def test_projection_of_a_map_pixel_is_its_source():
    lens = Intrinsics(64, 48, 60.0, 61.0, 31.3, 23.8, (0.05, -0.02, 0.001, -0.002, 0.003))
    to = undistort_map(lens)
    p = np.array([(10 - lens.cx) / lens.fx, (7 - lens.cy) / lens.fy, 1.0])
    assert np.allclose(project(lens.vector, p), [to.u_px[7, 10], to.v_px[7, 10]], atol=1e-12)

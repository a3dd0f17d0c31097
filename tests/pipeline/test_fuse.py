"""Fused clouds: points where the surface is, edges left out, pictures from every side."""

import numpy as np
import pytest

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.io.recording import open_recording
from rgbd_calib.pipeline.fuse import FuseParams, clouds_of, fullest_frame, on_jump
from rgbd_calib.report import splat
from rgbd_calib.types import Rig


def off_plane_m(tiny, points_m):
    return np.abs(points_m @ tiny.normal - tiny.offset_m)


def test_points_lie_on_the_surface_once_bias_and_lens_are_removed(tiny):
    clouds = clouds_of(open_recording(tiny.recording), tiny.rig, "000000")
    assert [cloud.camera for cloud in clouds] == ["C1", "C2"]
    for cloud in clouds:
        near = cloud.points_m @ tiny.normal < 0.6 * tiny.offset_m  # C1's second plane, half as far away
        assert np.any(near) == (cloud.camera == "C1")
        # depth is rounded to 0.5 mm, so off by 0.25 mm; the bias' slope of 1.02 and the longest ray (1.2 at the
        # image's corner, |(32 / 60, 24 / 61, 1)|) stretch it
        assert off_plane_m(tiny, cloud.points_m[~near]).max() < 0.00025 * 1.02 * 1.2
        assert np.all(cloud.colors == np.array(tiny.colors_bgr[cloud.camera])[::-1])


def test_depth_edges_are_left_out_and_counted(tiny):
    cloud = clouds_of(open_recording(tiny.recording), tiny.rig, "000000")[0]
    assert cloud.dropped["edge"] == 2 * 48  # one column each side of the jump
    assert len(cloud.points_m) == 62 * 48


def test_a_jump_is_seen_beside_holes_too():
    depth_m = np.full((5, 6), 2.0)
    depth_m[:, 3:] = 2.1
    depth_m[:, 2] = np.nan
    assert not on_jump(depth_m, 0.02).any()
    depth_m[:, 2] = 2.0
    assert on_jump(depth_m, 0.02)[:, 2:4].all()
    assert not on_jump(depth_m, 0.02)[:, [0, 1, 4, 5]].any()


def test_max_depth_leaves_out_what_is_farther(tiny):
    clouds = clouds_of(open_recording(tiny.recording), tiny.rig, "000000", FuseParams(max_depth_m=1.2))
    assert clouds[0].points_m[:, 2].max() <= 1.2
    assert clouds[0].dropped["too far"] > 0


def test_the_default_frame_is_the_one_with_most_depth(tiny):
    recording = open_recording(tiny.recording)
    assert fullest_frame(recording, ("C1", "C2", "C3")) == "000000"
    with pytest.raises(CalibrationError, match="no depth images"):
        fullest_frame(recording, ("C3",))
    only = {"C2": tiny.rig.cameras["C2"]}
    with pytest.raises(CalibrationError, match="Frame 000000 has it"):
        clouds_of(recording, Rig("C2", only), "000001")


def test_a_rig_of_other_cameras_and_an_unknown_frame_are_errors(tiny):
    recording = open_recording(tiny.recording)
    with pytest.raises(ConfigError, match="the rig has D1"):
        clouds_of(recording, Rig("D1", {"D1": tiny.rig.cameras["C1"]}), "000000")
    with pytest.raises(ConfigError, match="Did you mean '000001'"):
        clouds_of(recording, tiny.rig, "00001")


def test_nearer_points_hide_farther_ones_from_every_side():
    points_m = np.array([[0.0, 0, 1], [0, 0, 2], [-1, -1, 1.5], [1, 1, 1.5]])
    colors = np.array([[255, 0, 0], [0, 0, 255], [0, 0, 0], [0, 0, 0]], np.uint8)
    for name, nearest in (("front", 0), ("back", 1)):
        picture = splat.render(points_m, colors, splat.viewpoint(name, [np.eye(4)], points_m), 60, 60)
        middle = picture[28:32, 28:32].reshape(-1, 3).min(axis=0)
        assert np.array_equal(middle, colors[nearest])


@pytest.mark.parametrize("name", splat.VIEWS)
def test_every_view_is_a_rotation_and_shows_the_cloud(name):
    rng = np.random.default_rng(0)
    points_m = rng.normal(0, 0.3, (2000, 3)) + np.array([0, 0, 2])
    view = splat.viewpoint(name, [np.eye(4)], points_m)
    assert np.allclose(view.R_view_world @ view.R_view_world.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(view.R_view_world) > 0
    picture = splat.render(points_m, np.zeros((2000, 3), np.uint8), view, 80, 60)
    assert np.mean(picture[20:40, 30:50] < 128) > 0.5


def test_up_in_the_picture_is_up_for_the_cameras():
    points_m = np.array([[0.0, -1, 2], [0, 1, 2], [-1, 0, 2], [1, 0, 2]])  # y is down: the first is the highest
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [0, 0, 0]], np.uint8)
    picture = splat.render(points_m, colors, splat.viewpoint("front", [np.eye(4)], points_m), 100, 100).astype(int)
    rows, columns = np.nonzero(picture[..., 0] - picture[..., 1] > 100)
    assert rows.max() < 20 and 40 < columns.mean() < 60
    rows, columns = np.nonzero(picture[..., 2] - picture[..., 1] > 100)
    assert columns.max() < 20 and 40 < rows.mean() < 60


def test_pictures_look_where_clouds_overlap():
    rng = np.random.default_rng(0)
    common, left, right = (
        rng.uniform(-0.5, 0.5, (20_000, 3)) + np.array(c) for c in ((0, 0, 3), (-4, 0, 3), (4, 0, 3))
    )
    clouds_m = [np.concatenate([common[::2], left]), np.concatenate([common[1::2], right])]
    focus_m = splat.seen_by_several(clouds_m)
    # cells are 1 % of the extent of 9 m
    assert np.abs(focus_m - [0, 0, 3]).max() < 0.5 + 0.09
    assert len(splat.seen_by_several([left, right])) == 40_000
    assert len(splat.seen_by_several([left])) == 20_000


def test_every_camera_has_its_own_color():
    assert len({splat.camera_color(i) for i in range(40)}) == 40


def test_command_writes_a_cloud_that_open3d_reads_and_pictures(run, tiny, tmp_path):
    import open3d as o3d

    outcome = run("fuse", tiny.recording, "--rig", tiny.rig_path, "--image", "-o", tmp_path / "a.ply")
    assert outcome.status == 0, outcome.stderr
    assert outcome.stdout == ""
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.front.png", "a.ply", "a.top.png"]
    cloud = o3d.io.read_point_cloud(str(tmp_path / "a.ply"))
    points_m = np.asarray(cloud.points)
    assert len(points_m) == 62 * 48 + 64 * 48
    assert {tuple(c) for c in np.rint(np.asarray(cloud.colors) * 255).astype(int)} == {(200, 20, 10), (10, 200, 20)}


def test_command_with_a_color_for_each_camera(run, tiny, tmp_path):
    import open3d as o3d

    out = tmp_path / "a.ply"
    args = ("fuse", tiny.recording, "--rig", tiny.rig_path, "--color", "camera", "--view", "oblique", "-o", out)
    assert run(*args).status == 0
    colors = np.rint(np.asarray(o3d.io.read_point_cloud(str(out)).colors) * 255).astype(int)
    assert {tuple(c) for c in colors} == {splat.camera_color(0), splat.camera_color(1)}
    assert (tmp_path / "a.oblique.png").exists()


def test_command_replaces_nothing_unasked(run, tiny, tmp_path):
    (tmp_path / "a.front.png").write_text("mine")
    args = ("fuse", tiny.recording, "--rig", tiny.rig_path, "--view", "front", "-o", tmp_path / "a.ply")
    outcome = run(*args)
    assert outcome.status == 2 and "--overwrite" in outcome.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["a.front.png"]
    assert run(*args, "--overwrite").status == 0


@pytest.mark.parametrize(
    ("extra", "needle"),
    [(("--frame", "7"), "is not there"), (("--max-depth", "0.01"), "no depth is left")],
)
def test_command_errors_leave_nothing(run, tiny, tmp_path, extra, needle):
    outcome = run("fuse", tiny.recording, "--rig", tiny.rig_path, *extra, "-o", tmp_path / "a.ply")
    assert outcome.status == 2 and needle in outcome.stderr
    assert list(tmp_path.iterdir()) == []
    assert run("fuse", tiny.recording, "--rig", tiny.rig_path, "-o", tmp_path / "a.pcd").status == 2


def test_real_recording_with_its_published_rig(real_data):
    import yaml

    from rgbd_calib.types import RigCamera

    folder = real_data("percipio4_vga")
    recording = open_recording(folder)
    published = yaml.safe_load((folder / "published.yaml").read_text())["cameras"]
    cameras = {
        name: RigCamera(info.intrinsics, np.array(published[name]["T_left_top_camera"]), np.zeros((6, 6)))
        for name, info in recording.cameras.items()
    }
    clouds = clouds_of(recording, Rig("left_top", cameras), "000000")
    assert len(clouds) == 4
    for cloud in clouds:
        # the board stands at 2.25 m in front of a shelf; measured depth is up to 0.9 % (20 mm) too long
        assert 1.5 < np.median(cloud.points_m[:, 2]) < 3.0
        assert 0 < cloud.dropped["edge"] < 0.1 * len(cloud.points_m)

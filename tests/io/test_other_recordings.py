"""Recordings as people have them: two commands from the raw files to a rig, or to why there is none."""

from __future__ import annotations

import shutil

import numpy as np
import other_layouts
import pytest
from small_recording import camera_pose, draw_recording

from rgbd_calib.geometry import se3
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_rig

BOARD = "--board", "9x6", "--square", "0.06"
N_SD = 5
"""Standard deviations that a pose may be off: 1 in 10^5 of them is, with the 6 numbers of one camera."""


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    return open_recording(draw_recording(tmp_path_factory.mktemp("others") / "drawn", cameras=2, frames=14))


def is_right(path) -> None:
    """The second camera stands where it was drawn, within what the rig states."""
    rig = read_rig(path)
    first, second = rig.cameras.values()
    np.testing.assert_array_equal(first.T_world_color, np.eye(4))
    sd_m = np.sqrt(np.diag(second.covariance)[3:])
    off_m = np.abs(second.T_world_color[:3, 3] - camera_pose(1, 2)[:3, 3])
    assert np.all(off_m < N_SD * sd_m) and np.all(sd_m < 0.003)


def calibrates_right(run, recording, path) -> None:
    ended = run("calibrate", recording, "-o", path)
    assert ended.status == 0, ended.stderr
    is_right(path)


def test_stems_of_ones_own_with_tiff_depth(run, drawn, tmp_path):
    folder = other_layouts.stems_and_tiff(drawn, tmp_path / "monday")
    assert run("init", folder, *BOARD, "--yes").status == 0
    calibrates_right(run, folder, tmp_path / "rig.yaml")


def test_a_video_and_a_folder_of_depth_for_each_camera(run, drawn, tmp_path):
    folder = other_layouts.videos_and_depth(drawn, tmp_path / "session")
    imported = run("import", folder, "-o", tmp_path / "rec", *BOARD)
    assert imported.status == 0 and "by the board's size" in imported.stderr, imported.stderr
    calibrates_right(run, tmp_path / "rec", tmp_path / "rig.yaml")


def test_ros2_bag_of_two_rational_lenses(run, drawn, tmp_path):
    path = other_layouts.ros2_bag(drawn, tmp_path / "bag")
    assert run("import", path, "-o", tmp_path / "rec", *BOARD).status == 0
    lens = open_recording(tmp_path / "rec").cameras["C2"].intrinsics
    assert lens is not None and lens.distortion == tuple(other_layouts.RATIONAL)
    calibrates_right(run, tmp_path / "rec", tmp_path / "rig.yaml")


def test_a_session_of_caliscope(run, drawn, tmp_path):
    folder = other_layouts.caliscope(drawn, tmp_path / "session")
    assert run("import", folder, "-o", tmp_path / "rec", *BOARD).status == 0
    calibrates_right(run, tmp_path / "rec", tmp_path / "rig.yaml")


def test_names_that_never_coincide(run, drawn, tmp_path):
    folder = tmp_path / "apart"
    shutil.copytree(drawn.path, folder)
    n = len(drawn.frames)
    for camera, first in (("C1", 0), ("C2", 100_000)):
        for kind in ("color", "depth"):
            for i in range(n):
                path = folder / camera / kind / f"{i:06d}.png"
                path.rename(path.with_name(f"{first + i:06d}.png"))
        rows = [f"{first + i:06d},{33_333 * i},{33_333 * i + 5000}" for i in range(n)]
        (folder / camera / "timestamps.csv").write_text("\n".join(["frame,color_us,depth_us", *rows]) + "\n")
    refused = run("calibrate", folder, "-o", tmp_path / "rig.yaml")
    assert refused.status == 1 and "C2: 100000, 100001, 100002" in refused.stderr
    assert "--match timestamp" in refused.stderr
    assert run("import", folder, "-o", tmp_path / "rec", "--match", "timestamp").status == 0
    assert run("calibrate", tmp_path / "rec", "-o", tmp_path / "rig.yaml").status == 0
    is_right(tmp_path / "rig.yaml")


def test_iai_folder_of_one_kinect2(run, real_data, tmp_path):
    folder = other_layouts.iai(open_recording(real_data("kinect2_20")), tmp_path / "kinect2")
    assert run("import", folder, "-o", tmp_path / "rec", "--board", "7x5", "--square", "0.03").status == 0
    ended = run("calibrate", tmp_path / "rec", "-o", tmp_path / "rig.yaml")
    assert ended.status == 0, ended.stderr
    own = read_rig(tmp_path / "rig.yaml").cameras["C1"].depth_camera
    assert own is not None and abs(np.linalg.norm(own.T_color_depth[:3, 3]) - 0.052) < 0.01  # by design


@pytest.mark.parametrize("name", ["realsense_single.bag", "realsense_software_device.db3", "azure_kinect.mkv"])
def test_containers_of_makers(run, real_data, tmp_path, name):
    """They show no board: what is read is right, and that is said."""
    imported = run("import", real_data("containers") / name, "-o", tmp_path / "rec", *BOARD)
    assert imported.status == 0, imported.stderr
    ended = run("calibrate", tmp_path / "rec", "-o", tmp_path / "rig.yaml")
    assert ended.status == 1 and not (tmp_path / "rig.yaml").exists()
    assert "found in none of" in ended.stderr


def test_aprilgrid_of_kalibr(run, tmp_path):
    folder = other_layouts.kalibr(tmp_path / "april")
    inited = run("init", folder, "--yes")
    assert inited.status == 0 and "14 frames are in two cameras" in inited.stderr, inited.stderr
    assert "april_6x4.yaml: the board" in inited.stderr
    assert run("doctor", folder).status == 0
    ended = run("calibrate", folder, "-o", tmp_path / "rig.yaml")
    assert ended.status == 0, ended.stderr
    second = read_rig(tmp_path / "rig.yaml").cameras["cam1"]
    off = se3.difference(second.T_world_color, other_layouts.T_CAM0_CAM1)
    sd = np.sqrt(np.diag(second.covariance))
    assert np.all(np.abs(off) < N_SD * sd) and np.all(sd[3:] < 0.003), (off, sd)


def test_depth_of_half_the_size_of_colour(run, drawn, tmp_path):
    folder = other_layouts.half_depth(drawn, tmp_path / "half")
    inited = run("init", folder, *BOARD, "--registered", "--yes")
    assert inited.status == 0, inited.stderr
    own = open_recording(folder).cameras["C2"].depth
    assert own is not None and (own.width, own.height) == (320, 240)
    calibrates_right(run, folder, tmp_path / "rig.yaml")

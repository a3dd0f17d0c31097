"""`import` of folders, videos and recordings: what is written is what was there, and what is not used is named."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from foreign_files import save, write_video
from small_recording import draw_recording

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.files import load_yaml
from rgbd_calib.io.foreign.own import OwnRecording
from rgbd_calib.io.foreign.videos import numbers_of_frames
from rgbd_calib.io.recording import open_recording
from rgbd_calib.pipeline.import_sources import OpenOptions, open_source

RNG = np.random.default_rng(0)
N, HEIGHT, WIDTH = 4, 48, 64
COLOR = RNG.integers(0, 256, (N, HEIGHT, WIDTH, 3), np.uint8)
DEPTH = RNG.integers(1, 9000, (N, HEIGHT, WIDTH), np.uint16)
MM = "--depth-scale", "0.001"


def same(folder: Path, camera: str = "C1", depth: np.ndarray | None = DEPTH, scale_m: float = 0.001) -> None:
    """Colour and depth came through bit by bit."""
    recording = open_recording(folder)
    assert recording.unused == () and len(recording.color_files[camera]) == N
    for i, frame in enumerate(recording.color_files[camera]):
        np.testing.assert_array_equal(recording.color(camera, frame), COLOR[i])
        if depth is not None:
            np.testing.assert_allclose(recording.depth_own_m(camera, frame), depth[i] * scale_m, rtol=1e-7)


def write_bop(folder: Path) -> Path:
    entry = {"cam_K": [50.0, 0, 31.5, 0, 51.0, 23.5, 0, 0, 1], "depth_scale": 0.1}
    for i in range(N):
        save(folder / "rgb" / f"{i:06d}.png", COLOR[i])
        save(folder / "depth" / f"{i:06d}.png", DEPTH[i])
    (folder / "scene_camera.json").write_text(json.dumps({str(i): entry for i in range(N)}))
    return folder


def test_bop_scene(run, tmp_path):
    outcome = run("import", write_bop(tmp_path / "scene"), "-o", tmp_path / "out")
    assert outcome.status == 0, outcome.stderr
    same(tmp_path / "out", scale_m=0.0001)
    lens = open_recording(tmp_path / "out").cameras["C1"].intrinsics
    assert lens is not None and (lens.fx, lens.fy, lens.cx) == (50.0, 51.0, 31.5)


def test_bop_scene_of_images_that_differ(run, tmp_path):
    folder = write_bop(tmp_path / "scene")
    tree = json.loads((folder / "scene_camera.json").read_text())
    tree["0"]["cam_K"][0] = 49.0
    (folder / "scene_camera.json").write_text(json.dumps(tree))
    outcome = run("import", folder, "-o", tmp_path / "out")
    assert outcome.status == 0 and "cam_K differs from image to image" in outcome.stderr
    tree["0"]["depth_scale"] = 1.0
    (folder / "scene_camera.json").write_text(json.dumps(tree))
    outcome = run("import", folder, "-o", tmp_path / "other")
    assert (
        outcome.status == 2
        and "depth_scale [0.1, 1.0] seen, one from 0.001 to 1000 for all images needed" in outcome.stderr
    )


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".npy", ".npz", ".exr"])
@pytest.mark.parametrize("floating", [False, True])
def test_any_folder(run, tmp_path, suffix, floating):
    if suffix == ".exr":
        pytest.importorskip("OpenEXR")
    if (suffix == ".png" and floating) or (suffix == ".exr" and not floating):
        pytest.skip("no such files")
    folder = tmp_path / "scan"
    for i in range(N):
        save(folder / "color" / f"frame-{i:06d}.color.jpg", COLOR[i])
        image = (DEPTH[i] * 0.001).astype(np.float32) if floating else DEPTH[i]
        path = folder / "depth" / f"frame-{i:06d}.depth{suffix}"
        if suffix == ".exr":
            write_exr(path, image)
        else:
            save(path, image)
    options = () if floating else MM
    outcome = run("import", folder, "-o", tmp_path / "out", *options)
    assert outcome.status == 0, outcome.stderr
    recording = open_recording(tmp_path / "out")
    for i, frame in enumerate(recording.frames):
        np.testing.assert_allclose(recording.depth_m("C1", frame), DEPTH[i] * 0.001, rtol=1e-6)
        # what recordings read is copied, not converted
        source = folder / "color" / f"frame-{i:06d}.color.jpg"
        assert recording.color_files["C1"][frame].read_bytes() == source.read_bytes()
    assert "taken as registered" in outcome.stderr


def write_exr(path: Path, image: np.ndarray) -> None:
    import OpenEXR

    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Z": image}).write(str(path))


def test_a_lens_beside_the_images(run, tmp_path):
    folder = tmp_path / "scan"
    for i in range(N):
        save(folder / "color" / f"{i:06d}.png", COLOR[i])
        save(folder / "depth" / f"{i:06d}.png", DEPTH[i])
    (folder / "intrinsic_color.txt").write_text("50 0 31.5 0\n0 51 23.5 0\n0 0 1 0\n0 0 0 1\n")
    outcome = run("import", folder, "-o", tmp_path / "out", *MM)
    assert outcome.status == 0 and "lens of intrinsic_color.txt" in outcome.stderr, outcome.stderr
    lens = open_recording(tmp_path / "out").cameras["C1"].intrinsics
    assert lens is not None and lens.fy == 51.0


def test_depth_of_half_the_size(run, tmp_path):
    folder = tmp_path / "scan"
    for i in range(N):
        save(folder / "C1" / "rgb" / f"{i:06d}.png", COLOR[i])
        save(folder / "C1" / "depth" / f"{i:06d}.png", np.ascontiguousarray(DEPTH[i, ::2, ::2]))
    outcome = run("import", folder, "-o", tmp_path / "apart", *MM)
    assert outcome.status == 0 and "taken as not registered" in outcome.stderr, outcome.stderr
    own = open_recording(tmp_path / "apart").cameras["C1"].depth
    assert own is not None and (own.width, own.height, own.T_color_depth) == (32, 24, None)
    outcome = run("import", folder, "-o", tmp_path / "same", "--registered", *MM)
    own = open_recording(tmp_path / "same").cameras["C1"].depth
    assert outcome.status == 0 and own is not None
    np.testing.assert_array_equal(own.T_color_depth, np.eye(4))
    lens = Intrinsics(WIDTH, HEIGHT, 50.0, 51.0, 31.5, 23.5)
    depth_camera = own.camera(lens)
    assert depth_camera is not None and depth_camera.intrinsics.fx == 25.0 and depth_camera.intrinsics.cx == 15.5


def test_patterns_and_what_they_leave(run, tmp_path):
    folder = tmp_path / "scan"
    for i in range(N):
        save(folder / f"shot{i}" / "a_left.png", COLOR[i])
        save(folder / f"shot{i}" / "a_right.png", COLOR[i])
        save(folder / f"shot{i}" / "b_left.png", DEPTH[i])
    patterns = "--color", "shot{frame}/a_{camera}.png", "--depth", "shot{frame}/b_{camera}.png"
    outcome = run("import", folder, "-o", tmp_path / "out", *patterns, *MM)
    assert outcome.status == 0, outcome.stderr
    same(tmp_path / "out", "left")
    same(tmp_path / "out", "right", None)
    assert run("import", folder, "-o", tmp_path / "x", *patterns[2:]).status == 2


def test_iai_folder_of_a_kinect2(run, real_data, tmp_path):
    """The recording in its own form: the same bytes, joined by their numbers."""
    original = open_recording(real_data("kinect2_20"))
    folder = tmp_path / "iai"
    folder.mkdir()
    for frame, path in original.color_files["kinect2"].items():
        number = int("".join(c for c in frame if c.isdigit()))
        shutil.copyfile(path, folder / f"{number:04d}_sync_color{path.suffix}")
        for kind, files in (("ir", original.ir_files), ("depth", original.depth_files)):
            shutil.copyfile(files["kinect2"][frame], folder / f"{number:04d}_sync_{kind}.png")
        save(folder / f"{number:04d}_sync_grey_ir.png", np.zeros((424, 512), np.uint8))
    outcome = run("import", folder, "-o", tmp_path / "out", "--board", "7x5", "--square", "0.03")
    assert outcome.status == 0, outcome.stderr
    assert "21 colour and 21 depth frames, 21 infrared" in outcome.stderr
    assert "21 grey_ir images are not used" in outcome.stderr
    recording = open_recording(tmp_path / "out")
    assert recording.unused == () and recording.board is not None
    info = recording.cameras["C1"]
    assert info.depth is not None and (info.depth.width, info.depth.height, info.depth_scale) == (512, 424, 0.001)
    for kind in ("color_files", "depth_files", "ir_files"):
        mine, theirs = getattr(recording, kind)["C1"], getattr(original, kind)["kinect2"]
        assert [p.read_bytes() for p in mine.values()] == [p.read_bytes() for p in theirs.values()]


def test_libfreenect2_dump(run, tmp_path):
    folder = tmp_path / "dump"
    folder.mkdir()
    color = RNG.integers(0, 256, (1080, 1920, 4), np.uint8)
    depth = RNG.uniform(500, 4500, (424, 512)).astype(np.float32)
    depth[0, 0] = np.inf
    for i in range(2):
        color.tofile(folder / f"rgb_{i}.bin")
        depth.tofile(folder / f"depth_{i}.bin")
        (depth * 3).tofile(folder / f"ir_{i}.bin")
        depth.tofile(folder / f"registered_{i}.bin")
    outcome = run("import", folder, "-o", tmp_path / "out")
    assert outcome.status == 0 and "2 registered frames are not used" in outcome.stderr, outcome.stderr
    recording = open_recording(tmp_path / "out")
    np.testing.assert_array_equal(recording.color("C1", "0"), color[:, ::-1, :3])
    expected = np.rint(np.where(np.isfinite(depth), depth, np.nan))[:, ::-1] / 1000
    np.testing.assert_allclose(recording.depth_own_m("C1", "1"), expected)
    assert recording.ir("C1", "0").dtype == np.uint16 and not recording.depth_registered


def test_videos_with_folders_of_depth(run, tmp_path):
    folder = tmp_path / "session"
    for name in ("left", "right"):
        write_video(folder / name / "color.mkv", COLOR)
        for i in range(N):
            save(folder / name / "depth" / f"{i + 1:04d}.tiff", DEPTH[i])
    outcome = run("import", folder, "-o", tmp_path / "out", *MM)
    assert outcome.status == 0, outcome.stderr
    same(tmp_path / "out", "left")
    same(tmp_path / "out", "right")
    assert len(open_recording(tmp_path / "out").frames) == N


def test_a_video_of_depth_and_a_picture_of_it(run, tmp_path):
    folder = tmp_path / "session"
    write_video(folder / "cam0_color.mkv", COLOR)
    write_video(folder / "cam0_depth.mkv", DEPTH, pixels="gray16le")
    write_video(folder / "cam0_depth_colormap.mkv", COLOR)
    outcome = run("import", folder, "-o", tmp_path / "out", *MM)
    assert outcome.status == 0, outcome.stderr
    assert "cam0_depth_colormap.mkv is not used: a video of 8 bits is a picture of depth" in outcome.stderr
    same(tmp_path / "out", "C1")


def test_a_video_alone_and_a_broken_one(run, tmp_path):
    write_video(tmp_path / "a.mkv", COLOR)
    assert run("import", f"left={tmp_path / 'a.mkv'}", "-o", tmp_path / "out").status == 0
    same(tmp_path / "out", "left", None)
    (tmp_path / "b.mp4").write_bytes(b"no video" * 100)
    outcome = run("import", tmp_path / "b.mp4", "-o", tmp_path / "other")
    assert outcome.status == 2 and "cannot be read as a video" in outcome.stderr


def test_numbers_sort_as_numbers_and_other_files_are_named(run, tmp_path):
    folder = tmp_path / "scan"
    for i in range(8, 8 + N):
        save(folder / "color" / f"{i}.png", COLOR[i - 8])
        save(folder / "depth" / f"{i}.png", DEPTH[i - 8])
    (folder / "mesh.ply").write_text("ply")
    (folder / "notes.txt").write_text("kept beside")
    outcome = run("import", folder, "-o", tmp_path / "out", *MM)
    assert outcome.status == 0 and "not used: 1 .ply in . (as mesh.ply)" in outcome.stderr, outcome.stderr
    assert open_recording(tmp_path / "out").frames == ("08", "09", "10", "11")
    same(tmp_path / "out")


def test_numbers_of_frames():
    assert numbers_of_frames(["1", "2", "4"], 5) == ["000000", "000001", "000003"]
    assert numbers_of_frames(["000", "003"], 4) == ["000000", "000003"]
    assert numbers_of_frames(["16342", "16375"], 2) == ["000000", "000001"]
    assert numbers_of_frames(["a", "b"], 2) == ["000000", "000001"] and numbers_of_frames([], 2) == []


CHARUCO = """columns = 5
rows = 7
dictionary = "DICT_4X4_50"
aruco_scale = 0.75
square_size_override_cm = 5.4
inverted = false
"""


@pytest.mark.parametrize("old", [False, True])
def test_caliscope_session(run, tmp_path, old):
    root = tmp_path / "session"
    folder = root / "calibration" / "extrinsic"
    word, column, table = ("port", "port", "frame_time_history.csv") if old else ("cam", "cam_id", "timestamps.csv")
    rows = []
    for camera in (0, 1):
        write_video(folder / f"{word}_{camera}.mp4", COLOR, "libx264rgb", "rgb24")
        rows += [f"{camera},{100 + i / 30 + 0.004 * camera}" for i in range(N)]
    (folder / table).write_text("\n".join([f"{column},frame_time", *rows]) + "\n")
    (root / "charuco.toml").write_text(CHARUCO)
    outcome = run("import", root, "-o", tmp_path / "out")
    assert outcome.status == 0, outcome.stderr
    recording = open_recording(tmp_path / "out")
    assert tuple(recording.cameras) == ("cam_0", "cam_1") and len(recording.frames) == N
    assert recording.timestamps_us("cam_1")["000000"][0] == 4000
    board = recording.board
    assert board is not None and (board.cols, board.rows, board.type) == (4, 6, "charuco")
    assert board.square_m == pytest.approx(0.054)
    (folder / table).write_text("\n".join([f"{column},frame_time", *rows[1:]]) + "\n")
    outcome = run("import", root, "-o", tmp_path / "other")
    assert outcome.status == 2 and f"{N} frames seen, {N - 1} times" in outcome.stderr


@pytest.fixture
def apart(tmp_path) -> Path:
    """A recording whose two cameras name the same instants otherwise; their times overlap."""
    folder = draw_recording(tmp_path / "drawn", cameras=2, frames=3)
    for kind in ("color", "depth"):
        for i in range(3):
            (folder / "C2" / kind / f"{i:06d}.png").rename(folder / "C2" / kind / f"{100000 + i}.png")
    for camera, first in (("C1", 0), ("C2", 100000)):
        rows = [f"{first + i:06d},{33_333 * i},{33_333 * i + 5000}" for i in range(3)]
        (folder / camera / "timestamps.csv").write_text("\n".join(["frame,color_us,depth_us", *rows]) + "\n")
    return folder


@pytest.mark.parametrize("match", ["timestamp", "order"])
def test_frames_of_a_recording_are_joined_anew(run, apart, tmp_path, match):
    out = tmp_path / match
    outcome = run("import", apart, "-o", out, "--match", match)
    assert outcome.status == 0, outcome.stderr
    before, after = open_recording(apart), open_recording(out)
    assert after.frames == ("000000", "000001", "000002") and after.board == before.board
    assert {c: i.serial for c, i in after.cameras.items()} == {c: i.serial for c, i in before.cameras.items()}
    for kind in ("color_files", "depth_files"):
        for camera in ("C1", "C2"):
            mine, theirs = getattr(after, kind)[camera], getattr(before, kind)[camera]
            assert [p.read_bytes() for p in mine.values()] == [p.read_bytes() for p in theirs.values()]


def test_what_a_match_needs(run, apart, tmp_path):
    (apart / "C2" / "timestamps.csv").unlink()
    outcome = run("import", apart, "-o", tmp_path / "out", "--match", "timestamp")
    assert outcome.status == 2 and "C2: no timestamps in it" in outcome.stderr
    assert OwnRecording(apart).stamps().keys() == {"C1"}


def test_the_unit_of_depth_by_the_board(run, tmp_path):
    """A folder of units that nothing states: the board's size tells them."""
    drawn = draw_recording(tmp_path / "drawn", cameras=1, frames=10)
    folder = tmp_path / "scan"
    for frame, path in open_recording(drawn).depth_files["C1"].items():
        save(folder / "depth" / f"{frame}.png", cv2.imread(str(path), cv2.IMREAD_UNCHANGED) * 5)
        shutil.copyfile(drawn / "C1" / "color" / f"{frame}.png", folder / f"color_{frame}.png")
    outcome = run("import", folder, "-o", tmp_path / "out", "--board", "9x6", "--square", "0.06")
    assert outcome.status == 0 and "0.0002 m for each unit of depth, by the board's size" in outcome.stderr
    assert load_yaml(tmp_path / "out" / "dataset.yaml")["cameras"]["C1"]["depth_scale"] == 0.0002
    wrong = run("import", folder, "-o", tmp_path / "wrong", "--board", "9x6", "--square", "0.045")
    assert wrong.status == 1 and "none in use has" in wrong.stderr and "--depth-scale" in wrong.stderr
    again = run("import", folder, "-o", tmp_path / "wrong", "--depth-scale", "0.0002")
    assert again.status == 0 and "20 images were there from an earlier import" in again.stderr


def test_an_image_that_is_left_out_is_named_once(tmp_path):
    for i in range(N):
        save(tmp_path / "cam0" / "color" / f"{i:06d}.png", COLOR[i])
        save(tmp_path / "cam0" / "mask" / f"{i:06d}.png", COLOR[i])
    remarks = open_source(tmp_path, "C1", OpenOptions()).remarks
    assert [remark for remark in remarks if ".png" in remark] == [
        f"{tmp_path}: {N} files cam0/mask/{{frame}}.png are not used ({WIDTH}x{HEIGHT} px, color)"
    ]

"""Recordings in other layouts, depth that is not where it should be, files that nobody reads."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_recording import draw_recording
from tiny_recording import DEPTH, HEIGHT, WIDTH, edit

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.dataset import CameraInfo, write_dataset
from rgbd_calib.io.layout import FilePatterns
from rgbd_calib.io.recording import open_recording, save_color


def move(source: str, target: str):
    def change(folder: Path) -> None:
        for camera in ("C1", "C2"):
            (folder / camera / source).rename(folder / camera / "moving")
            (folder / camera / target).parent.mkdir(exist_ok=True, parents=True)
            (folder / camera / "moving").rename(folder / camera / target)

    return change


def rename_depth(form: str):
    def change(folder: Path) -> None:
        for path in list(folder.glob("*/depth/*.png")):
            path.rename(path.with_name(form.format(path.stem)))

    return change


@pytest.mark.parametrize(
    ("change", "needle"),
    [
        (rename_depth("depth_{}.png"), "C1: none of its 2 depth images has the name.*depth_000000.* and 000000"),
        (rename_depth("{}.exr"), r"C1/depth is there, and no depth image can be read \(2 .exr in C1/depth"),
        (move("depth", "Depth"), r"C1/Depth is there, .*2 .png in C1/Depth \(as 000000.png\)"),
        (move("depth", "depth/sensor"), r"C1/depth is there, .*2 .png in C1/depth/sensor"),
        (
            lambda f: [shutil.rmtree(f / c / "depth") or (f / c / "depth").mkdir() for c in ("C1", "C2")],
            "no other files",
        ),
        (
            lambda f: (
                [(f / c / "depth").rename(f / f"raw{c}") for c in ("C1", "C2")]
                and edit(f, lambda d: d.update(depth_scale=0.001))
            ),
            "dataset.yaml states a depth scale, and no depth image can be read.*2 .png in rawC1",
        ),
        (
            lambda f: (
                (f / "C2/depth").rename(f / "other") and edit(f, lambda d: d["cameras"]["C2"].update(depth_scale=0.001))
            ),
            "camera C2: dataset.yaml states its depth, and no depth image can be read.*2 .png in other",
        ),
    ],
)
def test_depth_that_is_expected_and_cannot_be_read_is_an_error(folder, change, needle):
    change(folder)
    with pytest.raises(ConfigError, match=needle) as caught:
        open_recording(folder)
    assert "rgbd-calib init" in str(caught.value)


def test_a_camera_without_depth_needs_none(folder):
    shutil.rmtree(folder / "C2" / "depth")
    assert open_recording(folder).depth_files["C2"] == {}


def test_files_that_nobody_reads_are_counted(folder):
    assert open_recording(folder).unused == () and open_recording(folder).remarks == ()
    (folder / "C1" / "masks").mkdir()
    (folder / "C1" / "masks" / "a.bin").write_bytes(b"")
    (folder / "C1" / "color" / "000000.heic").write_bytes(b"")
    (folder / "C1" / "timestamps.csv").write_text("frame,color_us,depth_us\n")
    (folder / "C2" / "color" / "000001.png").unlink()  # its depth image is then of no frame
    save_color(folder, "C3", "000000", np.zeros((2, 2, 3), np.uint8))
    (folder / "notes.txt").write_text("")
    (folder / "C1" / ".hidden").write_text("")
    recording = open_recording(folder)
    assert recording.unused == (
        "C1/color/000000.heic",
        "C1/masks/a.bin",
        "C2/depth/000001.png",
        "C3/color/000000.png",
    )
    assert "4 files are not read: 1 .heic in C1/color (as 000000.heic)" in recording.remarks[0]


def test_doctor_and_calibrate_name_what_is_not_read(run, tmp_path):
    path = draw_recording(tmp_path / "drawn", 2, 2)
    (path / "C1" / "confidence").mkdir()
    (path / "C1" / "confidence" / "000000.raw").write_bytes(b"")
    said = "1 files are not read: 1 .raw in C1/confidence (as 000000.raw)"
    assert said in run("doctor", path).stdout
    assert f"Warning: {path}: {said}" in run("calibrate", path, "-o", tmp_path / "rig.yaml").stderr


@pytest.mark.parametrize(
    "files",
    [
        {"color": "rgb_{camera}_{frame}.png", "depth": "depth_{camera}_{frame}.png"},
        {"color": "{frame}/{camera}-rgb.png", "depth": "{frame}/{camera}-depth.png"},
        {"color": "color/{camera}/{camera}_{frame}.color.png", "depth": "depth.{camera}/f{frame}.png"},
    ],
)
def test_patterns_name_files_of_another_layout(folder, files):
    original = open_recording(folder)
    moved = folder.parent / "moved"
    for kind, of_camera in (("color", original.color_files), ("depth", original.depth_files)):
        for camera, paths in of_camera.items():
            for frame, path in paths.items():
                target = moved / files[kind].format(camera=camera, frame=frame)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, target)
    shutil.copy(folder / "dataset.yaml", moved)
    edit(moved, lambda data: data.update(files=files))
    recording = open_recording(moved)
    assert recording.frames == original.frames and recording.unused == ()
    np.testing.assert_array_equal(recording.depth_m("C2", "000001"), original.depth_m("C2", "000001"))
    assert recording.only("C1", "000000").color("C1", "000000").shape == (HEIGHT, WIDTH, 3)
    (moved / "rgb_C9_000000.png").write_bytes(b"")
    assert open_recording(moved).unused == ("rgb_C9_000000.png",)


@pytest.mark.parametrize(
    ("color", "needle"),
    [
        ("/tmp/{camera}_{frame}.png", "a path inside the recording"),
        ("../{camera}_{frame}.png", "a path inside the recording"),
        ("{camera}.png", "{frame} is missing"),
        ("{frame}.png", "{camera} is missing"),
        ("{camera}_{frame}_{index}.png", "all that a pattern may have in braces"),
        ("{camera}_{frame.png", "all that a pattern may have in braces"),
        (7, "files.color: 7 seen"),
    ],
)
def test_a_wrong_pattern_is_refused(folder, color, needle):
    edit(folder, lambda data: data.update(files={"color": color}))
    with pytest.raises(ConfigError, match=needle):
        open_recording(folder)


def test_two_files_of_one_image_are_refused(folder):
    edit(
        folder, lambda data: data.update(files={"color": "{camera}/color/{frame}.png", "depth": "{camera}/{frame}.png"})
    )
    shutil.copy(folder / "C1/color/000000.png", folder / "C1/color/000000.jpg")
    with pytest.raises(ConfigError, match="one image a frame needed"):
        edit(folder, lambda data: data.pop("files"))
        open_recording(folder)


def test_a_pattern_of_one_camera_needs_no_name(tmp_path):
    for frame in "012":
        cv2.imwrite(str(tmp_path / f"frame-00{frame}.color.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
        cv2.imwrite(str(tmp_path / f"frame-00{frame}.depth.png"), DEPTH)
    files = FilePatterns("frame-{frame}.color.png", "frame-{frame}.depth.png")
    write_dataset(tmp_path, {"C1": CameraInfo(WIDTH, HEIGHT)}, None, files=files)
    recording = open_recording(tmp_path)
    assert recording.files == files and recording.frames == ("000", "001", "002") and recording.has_depth("C1", "002")

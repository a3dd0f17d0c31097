"""Names of frames: their order, and cameras that have none in common."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from small_recording import draw_recording
from tiny_recording import edit

from rgbd_calib.io.dataset import CameraInfo, write_dataset
from rgbd_calib.io.recording import open_recording, save_color


def test_clocks_that_are_not_one(run, tmp_path):
    path = draw_recording(tmp_path / "drawn", 2, 2)
    edit(path, lambda d: d.update(synchronous=False))
    assert not open_recording(path).synchronous
    out = run("calibrate", path, "-o", tmp_path / "rig.yaml")
    assert out.status == 2 and "a colour timestamp of each of 2 frames expected" in out.stderr


def shift_frames(path: Path, camera: str) -> None:
    for image in list(path.glob(f"{camera}/*/*.png")):
        image.rename(image.with_name(f"{100000 + int(image.stem):06d}.png"))


def test_frames_are_in_the_order_of_their_numbers(tmp_path):
    """9 before 10: checks over time go by it."""
    for stem in ("10", "9", "2", "11"):
        save_color(tmp_path, "C1", stem, np.zeros((48, 64, 3), np.uint8))
    write_dataset(tmp_path, {"C1": CameraInfo(64, 48)}, None)
    recording = open_recording(tmp_path)
    assert recording.frames == ("2", "9", "10", "11") == tuple(recording.color_files["C1"])


def test_frames_that_never_have_the_same_name(run, tmp_path):
    path = draw_recording(tmp_path / "drawn", 2, 3)
    shift_frames(path, "C2")
    said = "C1, C2: no frame has the name of another camera's frame.*C1: 000000, 000001, 000002; C2: 100000, 100001, 100002"
    out = run("calibrate", path, "-o", tmp_path / "rig.yaml")
    assert out.status == 1
    assert _found(said, out.stderr) and "--match order" in out.stderr
    found = run("doctor", path).stdout
    assert any(line.startswith("- ") and _found(said, line) for line in found.splitlines())
    for camera, offset in (("C1", 0), ("C2", 100000)):
        rows = "".join(f"{offset + i:06d},{i * 33333},\n" for i in range(3))
        (path / camera / "timestamps.csv").write_text(f"frame,color_us,depth_us\n{rows}")
    found = run("doctor", path).stdout
    assert any(
        line.startswith("! ") and _found(said, line) and "--match timestamp" in line for line in found.splitlines()
    )


def test_cameras_filmed_one_after_the_other_have_no_name_in_common(run, tmp_path):
    path = draw_recording(tmp_path / "drawn", 2, 3)
    shift_frames(path, "C2")
    for camera, offset in (("C1", 0), ("C2", 100000)):
        rows = "".join(f"{offset + i:06d},{(offset + i) * 33333},\n" for i in range(3))
        (path / camera / "timestamps.csv").write_text(f"frame,color_us,depth_us\n{rows}")
    assert "no frame has the name" not in run("doctor", path).stdout


def test_one_camera_of_three_whose_names_differ(run, tmp_path):
    path = draw_recording(tmp_path / "drawn", 3, 2)
    shift_frames(path, "C3")
    out = run("calibrate", path, "-o", tmp_path / "rig.yaml")
    assert out.status == 1 and _found("C3: no frame has the name of another", out.stderr)


def _found(pattern: str, text: str) -> bool:
    return re.search(pattern, text) is not None

"""Folders that go wrong at first: what is refused says a way out, and that way works."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.images import read_image
from rgbd_calib.io.recording import open_recording

RNG = np.random.default_rng(0)
COLOR = RNG.integers(0, 256, (48, 64, 3), np.uint8)
DEPTH = RNG.integers(500, 4000, (48, 64), np.uint16)


def fill(folder, *parts: tuple[str, np.ndarray], frames: int = 3):
    """Images named by patterns with {camera} and {frame}, of the cameras Left and Right."""
    for pattern, image in parts:
        for camera in ("Left", "Right"):
            for frame in range(frames):
                path = folder / pattern.format(camera=camera, frame=frame)
                path.parent.mkdir(parents=True, exist_ok=True)
                if path.suffix == ".webp":
                    assert cv2.imwrite(str(path), image, [cv2.IMWRITE_WEBP_QUALITY, 101])  # lossless
                elif path.suffix == ".heic":
                    path.write_bytes(b"\0\0\0\x18ftypheic")
                else:
                    assert cv2.imwrite(str(path), image)
    return folder


@pytest.mark.parametrize("name", ["{camera}/color/{frame}.bmp", "{camera}/rgb/{frame}.bmp"])
def test_pictures_of_depth_are_refused_and_colour_alone_is_a_way_out(run, tmp_path, name):
    """Also where the folders are those of this program, so that depth would be read again."""
    folder = fill(tmp_path / "in", (name, COLOR), ("{camera}/depth/{frame}.png", (DEPTH // 20).astype(np.uint8)))
    refused = run("init", folder, "--yes")
    assert refused.status == 2 and "Left/depth/{frame}.png of 8 bits a pixel" in refused.stderr
    assert "--color PATTERN" in refused.stderr
    imported = run("import", folder, "-o", tmp_path / "out", "--color-only", "--yes")
    assert imported.status == 0 and "3 files Left/depth/{frame}.png are not used" in imported.stderr, imported.stderr
    done = run("init", folder, "--yes", "--color", name)
    assert done.status == 0, done.stderr
    assert "6 files are not read: 3 .png in Left/depth (as 0.png)" in done.stderr
    for recording in (open_recording(folder), open_recording(tmp_path / "out")):
        assert not any(recording.depth_files.values())
        assert np.array_equal(recording.color("Left", recording.frames[0]), COLOR)


def test_of_two_depth_folders_one_is_chosen_by_its_pattern(run, tmp_path):
    parts = [("{camera}/color/{frame}.png", COLOR), ("{camera}/depth/{frame}.png", DEPTH)]
    folder = fill(tmp_path / "in", *parts, ("{camera}/depth_filtered/{frame}.png", DEPTH + 1))
    refused = run("init", folder, "--yes", "--depth-scale", "0.001")
    assert refused.status == 2 and "Left/depth_filtered/{frame}.png" in refused.stderr
    assert "Say it: --depth PATTERN" in refused.stderr
    for chosen, offset in (("depth", 0), ("depth_filtered", 1)):
        pattern = f"{{camera}}/{chosen}/{{frame}}.png"
        done = run("init", folder, "--yes", "--depth-scale", "0.001", "--depth", pattern, "--overwrite")
        assert done.status == 0 and "3 files Left/depth" in done.stderr, done.stderr
        recording = open_recording(folder)
        np.testing.assert_allclose(recording.depth_m("Right", "2"), (DEPTH + offset) * 0.001, rtol=1e-6)
    wrong = run("init", folder, "--yes", "--depth", "{camera}/d/{frame}.png", "--overwrite")
    assert wrong.status == 2 and "no file is named as --depth {camera}/d/{frame}.png" in wrong.stderr


def test_webp_is_read(run, tmp_path):
    folder = fill(tmp_path / "in", ("{camera}_{frame}.webp", COLOR), ("{camera}_depth_{frame}.png", DEPTH))
    done = run("init", folder, "--yes", "--depth-scale", "0.001")
    assert done.status == 0 and "Left: 3 colour images 64x48 (Left_{frame}.webp)" in done.stderr, done.stderr
    assert np.array_equal(read_image(folder / "Left_1.webp"), COLOR[..., ::-1])
    data = (folder / "Left_1.webp").read_bytes()
    (folder / "Left_1.webp").write_bytes(data[: len(data) // 2])
    with pytest.raises(ConfigError, match=r"Left_1\.webp: damaged or no image"):
        read_image(folder / "Left_1.webp")


def test_images_that_cannot_be_read_are_named(run, tmp_path):
    folder = fill(tmp_path / "in", ("{camera}/rgb/{frame}.heic", COLOR), ("{camera}/depth/{frame}.png", DEPTH))
    refused = run("init", folder, "--yes")
    assert refused.status == 2 and "no colour images found" in refused.stderr
    assert "3 .heic in Left/rgb (as 0.heic), 3 .heic in Right/rgb" in refused.stderr


def test_numbers_written_in_two_ways_are_one_instant(run, tmp_path):
    """One camera's script pads with zeros, the other's does not: nothing would be shared, and nobody would say so."""
    folder = fill(
        tmp_path / "in", ("{camera}/color/{frame}.png", COLOR), ("{camera}/depth/{frame}.png", DEPTH), frames=12
    )
    for path in sorted((folder / "Left").rglob("*.png")):
        path.rename(path.with_name(f"{int(path.stem):04d}.png"))
    refused = run("init", folder, "--yes", "--depth-scale", "0.001")
    assert refused.status == 2 and "numbers written in several ways seen" in refused.stderr
    assert f"rgbd-calib import {folder} -o RECORDING" in refused.stderr
    imported = run("import", folder, "-o", tmp_path / "out", "--yes", "--depth-scale", "0.001")
    assert imported.status == 0, imported.stderr
    recording = open_recording(tmp_path / "out")
    assert len(recording.frames) == 12
    assert all(
        f in recording.color_files[c] and recording.has_depth(c, f) for c in recording.cameras for f in recording.frames
    )


def test_seconds_with_as_many_digits_as_python_prints(run, tmp_path):
    """`time.time()` in a name: 1732700000.5 beside 1732700001.0034."""
    folder = tmp_path / "in"
    for k, camera in enumerate(("Left", "Right")):
        for kind, image in (("rgb", COLOR), ("depth", DEPTH)):
            (folder / camera / kind).mkdir(parents=True)
            for i in range(12):
                stamp = round(1732700000 + 0.5 * i + 0.003 * k + 0.0014 * (kind == "depth"), 4)
                assert cv2.imwrite(str(folder / camera / kind / f"{stamp}.png"), image)
    imported = run("import", folder, "-o", tmp_path / "out", "--yes", "--depth-scale", "0.001", "--match", "timestamp")
    assert imported.status == 0, imported.stderr
    recording = open_recording(tmp_path / "out")
    assert len(recording.frames) == 12 and recording.timestamps_us("Right")[recording.frames[1]] == (503_000, 504_400)

"""Hostile recordings and rigs through the commands' own readers: refused in one line that names file, key and remedy."""

from __future__ import annotations

import io
import os
import shutil
import struct
import textwrap
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from rgbd_calib.errors import ConfigError
from rgbd_calib.io import correspondences, residuals
from rgbd_calib.io.capture_log import CaptureLog
from rgbd_calib.io.files import dump_yaml, load_yaml
from rgbd_calib.io.images import decode_image, read_image
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_rig
from rgbd_calib.io.rig_update import write_update
from rgbd_calib.pipeline.config import load_config

CORNERS = ",".join(correspondences.CORNERS)
LENS = "intrinsics: {width: 8, height: 6, fx: 9, fy: 9, cx: 4, cy: 3}"
POSE = "T_world_color: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
RIG = f"format: rgbd-calib/rig\nversion: 1\ncameras:\n  C1: {{{LENS}, {POSE}}}\n"


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Two cameras of 8 x 6 px, one frame."""
    folder = tmp_path / "recording"
    for camera in ("C1", "C2"):
        for kind, image in (("color", np.zeros((6, 8, 3), np.uint8)), ("depth", np.full((6, 8), 900, np.uint16))):
            (folder / camera / kind).mkdir(parents=True)
            cv2.imwrite(str(folder / camera / kind / "000000.png"), image)
    cameras = {c: {"width": 8, "height": 6} for c in ("C1", "C2")}
    board = {"cols": 9, "rows": 6, "square": 0.06}
    data = {"format": "rgbd-calib/dataset", "version": 1, "cameras": cameras, "board": board}
    (folder / "dataset.yaml").write_text(dump_yaml(data))
    return folder


def refused(path: Path, needle: str, read=None) -> None:
    """The reader says so, on one line of a length that can be read."""
    with pytest.raises(ConfigError, match=needle) as error:
        read(path) if read else everything(path)
    assert "\n" not in str(error.value) and len(str(error.value)) < 1000


def everything(folder: Path) -> None:
    """Read all that is in a recording."""
    opened = open_recording(folder)
    for camera in opened.cameras:
        for frame in opened.color_files[camera]:
            opened.color(camera, frame)
        for frame in opened.depth_files[camera]:
            opened.depth_m(camera, frame)
        opened.timestamps_us(camera)
        opened.distances_m(camera)


def test_the_recording_itself_is_read(recording):
    everything(recording)


@pytest.mark.parametrize(
    "name", ["../x", "/tmp", "a/b", "a\\b", ".", "..", "", ".hidden", "C:", "a\x00b", "a\nb", " a", "x" * 300]
)
def test_camera_names_that_lead_elsewhere(recording, name):
    data = load_yaml(recording / "dataset.yaml")
    data["cameras"][name] = data["cameras"].pop("C2")
    (recording / "dataset.yaml").write_text(dump_yaml(data))
    refused(recording, "dataset.yaml: .*a camera's name is that of its folder")
    path = recording / "rig.yaml"
    path.write_text(RIG.replace("C1:", dump_yaml({name: 1}).replace(": 1\n", ":")))
    with pytest.raises(ConfigError):
        read_rig(path)
    path.write_text(f'{CORNERS}\n"{name}",0,0,1,2,,0\n')
    with pytest.raises(ConfigError):
        correspondences.read_corners(path)


@pytest.mark.parametrize(
    ("key", "value", "needle"),
    [
        ("width", 10**9, "cameras.C1.width: 1000000000 seen; Input should be less than or equal to 8192"),
        ("width", True, "cameras.C1.width: True seen; a number is needed"),
        ("width", "many", "cameras.C1.width: 'many' seen"),
        ("height", 0, "cameras.C1.height: 0 seen"),
        ("depth_scale", float("nan"), "cameras.C1.depth_scale: nan seen"),
        ("depth_scale", float("inf"), "cameras.C1.depth_scale: inf seen"),
        ("depth_scale", "1e999", "cameras.C1.depth_scale: '1e999' seen"),
        ("depth_scale", 1000, "cameras.C1.depth_scale: 1000 seen; Input should be less than or equal to 1"),
        ("serial", ["a"] * 10_000, "cameras.C1.serial: .{1,70} seen"),
    ],
)
def test_absurd_values_of_a_camera(recording, key, value, needle):
    data = load_yaml(recording / "dataset.yaml")
    data["cameras"]["C1"][key] = value
    (recording / "dataset.yaml").write_text(dump_yaml(data))
    refused(recording, needle)


@pytest.mark.parametrize(
    ("key", "value"),
    [("cols", 10**6), ("rows", 1), ("square", 60), ("square", 0), ("thickness", 6.0), ("square", ".nan")],
)
def test_absurd_boards(recording, key, value):
    data = load_yaml(recording / "dataset.yaml")
    data["board"][key] = value
    (recording / "dataset.yaml").write_text(dump_yaml(data))
    refused(recording, f"dataset.yaml: line \\d+: board.{key}: .* seen")


def test_a_camera_twice(recording):
    text = (recording / "dataset.yaml").read_text()
    (recording / "dataset.yaml").write_text(text.replace("C2:", "C1:"))
    refused(recording, "dataset.yaml: line 7: key 'C1' stands there twice")


def test_a_frame_twice_under_two_suffixes(recording):
    cv2.imwrite(str(recording / "C1/color/000000.jpg"), np.zeros((6, 8, 3), np.uint8))
    refused(recording, "color: 000000.jpg and 000000.png seen, one image a frame needed")


@pytest.mark.parametrize("file", ["timestamps.csv", "distances.csv"])
@pytest.mark.parametrize(
    ("value", "needle"),
    [("nan", "finite"), ("inf", "finite"), ("1e999", "finite"), ("1_0", "a number needed"), ("٣", "a number needed")],
)
def test_tables_of_a_camera(recording, file, value, needle):
    header, cells = ("frame,color_us,depth_us", f"{value},1") if "time" in file else ("frame,distance_m", value)
    (recording / "C1" / file).write_text(f"{header}\n000000,{cells}\n")
    refused(recording, f"C1/{file}: line 2: .*{needle}")
    good = cells.replace(value, "1")
    (recording / "C1" / file).write_text(f"{header}\n000000,{good}\n000000,{good}\n")
    refused(recording, f"C1/{file}: line 3: frame '000000' stands there twice")
    (recording / "C1" / file).write_text(f"{header},frame\n000000,{good},000000\n")
    refused(recording, f"C1/{file}: line 1: column 'frame' is there twice")


@pytest.mark.parametrize(
    ("row", "needle"),
    [
        ("C1,0,0.5,1,2,,0", "feature: '0.5' seen, a whole number"),
        ("C1,0,-1,1,2,,0", "feature: '-1' seen, a whole number"),
        ("C1,0,1e30,1,2,,0", "feature: '1e30' seen"),
        ("C1,0,0,1e9,2,,0", "u_px: '1e9' seen, a finite number of 1e\\+06"),
        ("C1,0,0,1,nan,,0", "v_px: 'nan' seen"),
        ("C1,0,0,1,2,inf,0", "depth_m: 'inf' seen"),
        ("C1,0,0,1,2,-1,0", "depth_m: -1 seen; more than 0, or nothing"),
        ("C1,0,0,1,2,1,-3", "depth_pixels: '-3' seen"),
        ("C1,0,0,1,2,1,0\nC1,0,0,3,4,1,0", "line 3: camera C1 has feature 0 of frame 0 a second time"),
        ('"C1,0,0,1,2,,0', "cannot be read as CSV"),
        (f"{'x' * 200_000},0,0,1,2,,0", "cannot be read as CSV"),
    ],
    ids=lambda value: value[:24],
)
def test_tables_of_corners(tmp_path, row, needle):
    path = tmp_path / "corners.csv"
    path.write_text(f"{CORNERS}\n{row}\n")
    refused(path, needle, correspondences.read_corners)


def test_a_table_that_is_too_large_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr("rgbd_calib.io.tables.MAX_BYTES", 1 << 20)
    path = tmp_path / "corners.csv"
    path.write_text(f"{CORNERS}\n" + "C1,0,0,1,2,,0\n" * 100_000)
    refused(path, "corners.csv: larger than 1 MB", correspondences.read_corners)


def test_residuals_twice(tmp_path):
    path = tmp_path / "rig.residuals.csv"
    path.write_text(",".join(residuals.COLUMNS) + "\n" + "C1,0,0,1,2,,,,,none\n" * 2)
    refused(path, "line 3: camera, frame and feature .* stand there twice", residuals.read_residuals)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("fx: 9,", "fx: .nan,"),
        ("fx: 9,", "fx: 1.0e+300,"),
        ("fx: 9,", "fx: yes,"),
        ("[[1, 0, 0, 0]", "[[1.0e+200, 0, 0, 0]"),
        ("[[1, 0, 0, 0]", "[[.inf, 0, 0, 0]"),
        ("version: 1", "version: [1, 2, 3]"),
        ("C1:", "C1: {}\n  C1:"),
    ],
)
def test_numbers_of_a_rig(tmp_path, old, new):
    (tmp_path / "rig.yaml").write_text(RIG)
    read_rig(tmp_path / "rig.yaml")
    (tmp_path / "rig.yaml").write_text(RIG.replace(old, new))
    refused(tmp_path / "rig.yaml", "rig.yaml: ", read_rig)


@pytest.mark.parametrize(
    "text", ["seed: -1", "detect: {min_share: .nan}", "detect: {min_share: 1.0e+99}", "detect: 3", "? []"]
)
def test_numbers_of_a_configuration(tmp_path, text):
    (tmp_path / "config.yaml").write_text(text)
    refused(tmp_path / "config.yaml", "config.yaml: ", load_config)


def test_a_capture_log_of_another_make(tmp_path):
    head = "format: rgbd-calib/capture\nversion: 1\n"
    for text in ("sessions: 3", "sessions: [3]", "sessions: [{cameras: [C1]}]", "clock_zero_unix_s: .nan"):
        (tmp_path / "capture.yaml").write_text(head + text)
        refused(tmp_path, "capture.yaml: ", lambda folder: CaptureLog(folder, "", ""))


def png(width: int, height: int, data: bytes) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def test_a_bomb_is_measured_before_it_is_decoded(recording):
    """4 GB of zeros in 4 MB; Pillow itself would warn at 90 million pixels and stop at 180 million."""
    packed = zlib.compressobj(9)
    data = b"".join(packed.compress(bytes(1 << 20)) for _ in range(100)) + packed.flush()
    path = recording / "C1/color/000000.png"
    path.write_bytes(png(40_000, 40_000, data))
    refused(recording, "000000.png: 40000x40000 px seen, dataset.yaml says 8x6")
    refused(path, "40000x40000 px seen, 8192 a side at most", read_image)
    path.write_bytes(png(8, 6, data))  # as large as it says: the rest is never unpacked
    assert read_image(path).shape == (6, 8, 3)


@pytest.mark.parametrize("kind", ["GIF", "ICO", "TGA", "PCX"])
def test_other_formats_under_the_name_of_png(kind):
    stream = io.BytesIO()
    Image.new("RGB", (8, 6)).save(stream, kind)
    with pytest.raises(ConfigError, match="begin as none of PNG, JPEG"):
        decode_image(stream.getvalue(), "a.png")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
@pytest.mark.parametrize("file", ["dataset.yaml", "C1/color/000000.png", "C1/depth/000000.png", "C1/timestamps.csv"])
def test_a_pipe_in_a_recording_does_not_hang(recording, file):
    (recording / file).unlink(missing_ok=True)
    os.mkfifo(recording / file)
    refused(recording, f"{file}: a regular file was expected")


def test_a_folder_of_images_may_be_a_link(recording, tmp_path):
    """Labs keep images on another disk; what a link names was chosen by whoever made it, not by a file's content."""
    shutil.move(recording / "C1" / "color", tmp_path / "elsewhere")
    (recording / "C1" / "color").symlink_to(tmp_path / "elsewhere")
    everything(recording)


@pytest.mark.parametrize("file", ["../outside.png", "/etc/hostname", "a/../../outside.png", "C:\\x.png", "x" * 5000])
def test_a_tum_list_reads_nothing_outside_its_folder(run, tmp_path, file):
    (tmp_path / "tum").mkdir()
    cv2.imwrite(str(tmp_path / "outside.png"), np.zeros((6, 8, 3), np.uint8))
    (tmp_path / "tum" / "rgb.txt").write_text(f"1.0 {file}\n")
    out = run("import", tmp_path / "tum", "-o", tmp_path / "out")
    assert out.status == 2 and "rgb.txt: line 1: " in out.stderr and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "quality",
    [
        "{board: 3}",
        "{board: {cols: 9}}",
        "{pairs: 7}",
        "{expected_alignment: [1]}",
        "{rounds: [a]}",
        "{images: {C1: x}}",
    ],
)
def test_a_report_of_a_quality_that_is_none(run, tmp_path, quality):
    (tmp_path / "rig.yaml").write_text(f"{RIG}quality: {quality}\n")
    out = run("report", tmp_path / "rig.yaml", "-o", tmp_path / "page")
    assert out.status in (0, 2) and len(out.stderr.strip().splitlines()) <= 2, out.stderr
    assert out.status == 0 or "rig.yaml: quality: cannot be shown" in out.stderr
    assert out.status == 0 or not (tmp_path / "page").exists()


def test_cameras_that_differ_by_case_alone(recording):
    text = (recording / "dataset.yaml").read_text()
    (recording / "dataset.yaml").write_text(text.replace("C2:", "c1:"))
    refused(recording, "dataset.yaml: .*cameras C1 and c1 are one folder")


@pytest.mark.parametrize(
    "text", [RIG.replace("C1: {", "C1: &a {") + "  C2: *a\n", "<<:\n" + textwrap.indent(RIG, "  ")]
)
def test_a_rig_with_aliases_is_not_changed_in_place(tmp_path, text):
    """To replace the entry that others refer to would leave them without it."""
    path = tmp_path / "rig.yaml"
    path.write_text(text)
    rig = read_rig(path)
    with pytest.raises(ConfigError, match=r"rig.yaml: anchors"):
        write_update(path, path, "C1", rig.cameras["C1"], {}, {})
    assert path.read_text() == text

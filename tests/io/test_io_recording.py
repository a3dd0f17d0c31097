"""Recordings: what is written comes back, and every wrong file is named with what to do."""

import shutil

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.recording import (
    CameraInfo,
    open_recording,
    read_table,
    save_color,
    save_depth,
    write_dataset,
    write_table,
)
from rgbd_calib.types import Board


@pytest.fixture
def folder(tiny, tmp_path):
    shutil.copytree(tiny.recording, tmp_path / "r")
    return tmp_path / "r"


def edit(folder, change):
    path = folder / "dataset.yaml"
    data = yaml.safe_load(path.read_text())
    change(data)
    path.write_text(yaml.safe_dump(data, sort_keys=False))


def test_dataset_there_and_back(tmp_path):
    lens = Intrinsics(8, 6, 7.123456789012345, 7.0, 3.5, 2.5, (0.1, 0.0, 0.0, 0.0, 1e-17))
    cameras = {"A": CameraInfo(8, 6, 0.00025, "s1", lens, depth_stated=True), "B": CameraInfo(8, 6)}
    board = Board(9, 6, 0.06, True, 0.006)
    for name in cameras:
        save_color(tmp_path, name, "7", np.zeros((6, 8, 3), np.uint8))
    save_depth(tmp_path, "A", "7", np.ones((6, 8), np.uint16))
    write_dataset(tmp_path, cameras, board, {"notes": {"by": "hand"}})
    back = open_recording(tmp_path)
    assert back.cameras == cameras and back.board == board and back.extra == {"notes": {"by": "hand"}}
    charuco = Board(9, 6, 0.06, type="charuco", marker_m=0.045, dictionary="DICT_5X5_250")
    write_dataset(tmp_path, cameras, charuco)
    assert open_recording(tmp_path).board == charuco


def test_images_there_and_back_bit_for_bit(tmp_path):
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (6, 8, 3), np.uint8)
    depth_raw = rng.integers(0, 65536, (6, 8)).astype(np.uint16)
    depth_raw[0, :3] = 0, 1, 65535
    save_color(tmp_path, "A", "0", color)
    save_depth(tmp_path, "A", "0", depth_raw)
    write_dataset(tmp_path, {"A": CameraInfo(8, 6, 0.00025)}, None)
    back = open_recording(tmp_path)
    assert np.array_equal(back.color("A", "0"), color)
    depth_m = back.depth_m("A", "0")
    measured = (depth_raw != 0) & (depth_raw != 65535)
    assert np.array_equal(np.isfinite(depth_m), measured)
    assert np.array_equal(np.rint(np.nan_to_num(depth_m) / 0.00025), np.where(measured, depth_raw, 0))


def test_frames_cameras_and_missing_depth(tiny):
    recording = open_recording(tiny.recording)
    assert recording.frames == ("000000", "000001") and list(recording.cameras) == ["C1", "C2", "C3"]
    assert recording.has_depth("C1", "000001") and not recording.has_depth("C2", "000001")
    assert not recording.has_depth("C3", "000000") and recording.depth_files["C3"] == {}
    assert recording.distances_m("C1") == {} and recording.timestamps_us("C1") == {}


def test_a_camera_may_lack_a_frame(folder):
    (folder / "C2" / "color" / "000001.png").unlink()
    recording = open_recording(folder)
    assert recording.frames == ("000000", "000001") and list(recording.color_files["C2"]) == ["000000"]


def test_grey_and_palette_images_are_read_as_colour(folder):
    rng = np.random.default_rng(0)
    grey = rng.integers(0, 256, (48, 64), np.uint8)
    path = folder / "C1" / "color" / "000000.png"
    Image.fromarray(grey).save(path)
    assert np.array_equal(open_recording(folder).color("C1", "000000"), np.repeat(grey[..., None], 3, 2))
    Image.fromarray(grey).convert("P").save(path)
    assert open_recording(folder).color("C1", "000000").shape == (48, 64, 3)
    Image.fromarray(np.dstack([grey, grey, grey, grey])).save(path)  # with transparency
    assert open_recording(folder).color("C1", "000000").shape == (48, 64, 3)


def test_digest_changes_with_any_byte_and_with_nothing_else(folder, tmp_path):
    before = open_recording(folder).digest()
    shutil.copytree(folder, tmp_path / "copy")
    assert open_recording(tmp_path / "copy").digest() == before
    save_color(folder, "C1", "000000", np.zeros((48, 64, 3), np.uint8))
    assert open_recording(folder).digest() != before


def test_tables_of_distances_and_time_stamps(folder):
    write_table(folder / "C1" / "distances.csv", ("frame", "distance_m"), [("000000", 0.8), ("000001", 1.2)])
    write_table(
        folder / "C1" / "timestamps.csv", ("frame", "color_us", "depth_us"), [("000000", 5, ""), ("000001", 7, 8)]
    )
    recording = open_recording(folder)
    assert recording.distances_m("C1") == {"000000": (0.8, None), "000001": (1.2, None)}
    write_table(folder / "C1" / "distances.csv", ("frame", "distance_m", "sd_m"), [("000000", 0.8, 0.002)])
    assert recording.distances_m("C1") == {"000000": (0.8, 0.002)}
    stamps = recording.timestamps_us("C1")
    assert stamps["000000"][0] == 5 and np.isnan(stamps["000000"][1]) and stamps["000001"] == (7, 8)


def remove(*parts):
    return lambda folder: shutil.rmtree(folder.joinpath(*parts))


def write_png(name, image):
    return lambda folder: cv2.imwrite(str(folder / name), image)


def truncate(name, share=0.5):
    def cut(folder):
        path = folder / name
        whole = path.read_bytes()
        path.write_bytes(whole[: int(share * len(whole))])

    return cut


def setting(*path_and_value):
    *path, value = path_and_value

    def change(data):
        for key in path[:-1]:
            data = data[key]
        data[path[-1]] = value

    return lambda folder: edit(folder, change)


@pytest.mark.parametrize(
    ("spoil", "needle"),
    [
        (lambda folder: shutil.rmtree(folder), "no such folder"),
        (lambda folder: (folder / "dataset.yaml").unlink(), "no dataset.yaml"),
        (remove("C2", "color"), "camera C2 of dataset.yaml has no images"),
        (setting("version", 7), "version: 7 seen"),
        (setting("depth_registered", False), "no camera says which geometry its depth has"),
        (setting("cameras", {}), "cameras"),
        (setting("cameras", "C1", "width", 0), r"cameras.C1.width: 0 seen"),
        (setting("cameras", "C1", {"widht": 64, "height": 48}), "no such key 'widht'; did you mean 'width'"),
        (setting("board", "cols", 1), r"board.cols: 1 seen"),
        (setting("board", "square", -0.06), r"board.square: -0.06 seen"),
        (setting("board", "type", "charuco"), "a charuco board needs 'marker'"),
        (setting("board", "type", "circles"), r"board.type: 'circles' seen"),
        (setting("depth_scale", 0), "depth_scale: 0 seen"),
    ],
)
def test_a_wrong_recording_is_not_opened(folder, spoil, needle):
    spoil(folder)
    with pytest.raises(ConfigError, match=needle) as caught:
        open_recording(folder)
    assert str(folder) in str(caught.value)


@pytest.mark.parametrize(
    ("spoil", "needle"),
    [
        (truncate("C1/depth/000000.png"), r"C1/depth/000000.png: damaged"),
        (truncate("C1/depth/000000.png", 0.05), r"C1/depth/000000.png: damaged"),
        (truncate("C1/depth/000000.png", 0.95), r"C1/depth/000000.png: damaged"),
        (write_png("C1/depth/000000.png", np.ones((48, 64), np.uint8)), "8 bits and 1 channel.*needs 16 bits"),
        (
            write_png("C1/depth/000000.png", np.ones((48, 64, 3), np.uint16)),
            "channel.*depth needs 16 bits|8 bits and 3",
        ),
        (write_png("C1/depth/000000.png", np.ones((24, 32), np.uint16)), "32x24 px seen, the colour image has 64x48"),
        (lambda folder: (folder / "C1/depth/000000.png").write_bytes(b""), "damaged or no image"),
    ],
)
def test_wrong_depth_is_refused(folder, spoil, needle):
    spoil(folder)
    with pytest.raises(ConfigError, match=needle):
        open_recording(folder).depth_m("C1", "000000")


@pytest.mark.parametrize(
    ("spoil", "needle"),
    [
        (truncate("C1/color/000000.png"), r"C1/color/000000.png: damaged"),
        (write_png("C1/color/000000.png", np.ones((40, 64, 3), np.uint8)), "64x40 px seen, dataset.yaml says 64x48"),
        (write_png("C1/color/000000.png", np.ones((48, 64), np.uint16)), "16 bits a channel seen, 8 needed"),
    ],
)
def test_wrong_colour_is_refused(folder, spoil, needle):
    spoil(folder)
    with pytest.raises(ConfigError, match=needle):
        open_recording(folder).color("C1", "000000")


def test_the_folder_above_gets_a_hint(folder):
    with pytest.raises(ConfigError, match=f"Did you mean one of .*{folder.name}"):
        open_recording(folder.parent)


@pytest.mark.parametrize(
    ("text", "needle"),
    [
        ("frame,distance\n0,1\n", "line 1: column 'distance_m' is missing; seen: frame, distance"),
        ("frame,distance_m\n0,1\n1,far\n", "line 3: distance_m: 'far' seen, a number needed"),
        ("frame,distance_m\n0\n", "line 2: 2 fields needed"),
        ("frame,distance_m\n0,1,2\n", "line 2: 2 fields needed"),
        ("", "line 1: column 'frame' is missing; seen: nothing"),
    ],
)
def test_a_wrong_table_is_named_by_line(folder, text, needle):
    (folder / "C1" / "distances.csv").write_text(text)
    with pytest.raises(ConfigError, match=needle):
        open_recording(folder).distances_m("C1")


def test_tables_of_spreadsheets_with_a_byte_order_mark_are_read(tmp_path):
    (tmp_path / "a.csv").write_bytes(b"\xef\xbb\xbfframe,distance_m\r\n0,1.5\r\n")
    rows = list(read_table(tmp_path / "a.csv", ("frame", "distance_m")))
    assert rows == [(2, {"frame": "0", "distance_m": "1.5"})]

"""A recording that grows: whole frame sets whatever happens, and going on with it."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.io.capture_log import CaptureLog
from rgbd_calib.io.growing_recording import CameraImages, GrowingRecording, append_line
from rgbd_calib.io.recording import open_recording
from rgbd_calib.types import Board

RNG = np.random.default_rng(0)


def images(*cameras: str, depth: bool = True) -> dict[str, CameraImages]:
    color = RNG.integers(0, 256, (24, 32, 3), np.uint8)
    raw = RNG.integers(0, 65536, (24, 32), np.uint16) if depth else None
    return {camera: CameraImages(color, raw, 1000, 1010, distance_m=0.8) for camera in cameras}


def test_what_is_added_comes_back(tmp_path):
    recording = GrowingRecording(tmp_path / "r", Board(9, 6, 0.06))
    recording.identify({"C1": "S1"})
    given = images("C1", "C2")
    recording.add(recording.reserve(), given, spread_us=12)
    opened = open_recording(tmp_path / "r")
    np.testing.assert_array_equal(opened.color("C1", "000000"), given["C1"].color)
    np.testing.assert_array_equal(np.nan_to_num(opened.depth_m("C2", "000000")), given["C2"].depth_raw * 0.001)
    assert opened.timestamps_us("C1") == {"000000": (1000.0, 1010.0)}
    assert opened.distances_m("C2") == {"000000": (0.8, None)}
    assert opened.cameras["C1"].serial == "S1" and opened.board == Board(9, 6, 0.06)


def test_a_camera_that_comes_later_is_listed_then(tmp_path):
    recording = GrowingRecording(tmp_path / "r")
    recording.add(recording.reserve(), images("C2"))
    assert list(open_recording(tmp_path / "r").cameras) == ["C2"]
    recording.add(recording.reserve(), images("C1", depth=False))
    opened = open_recording(tmp_path / "r")
    assert list(opened.cameras) == ["C1", "C2"] and not opened.has_depth("C1", "000001")


def test_going_on_continues_the_numbers_and_removes_leftovers(tmp_path):
    first = GrowingRecording(tmp_path / "r", Board(9, 6, 0.06))
    first.add(first.reserve(), images("C1"))
    leftover = tmp_path / "r" / "C1" / "color" / ".000001.png"
    leftover.write_bytes(b"half")
    with pytest.raises(ConfigError, match=r"exists already.*--append"):
        GrowingRecording(tmp_path / "r")
    with pytest.raises(ConfigError, match="one recording has one board"):
        GrowingRecording(tmp_path / "r", Board(8, 5, 0.06), append=True)
    second = GrowingRecording(tmp_path / "r", append=True)
    assert second.reserve() == "000001" and second.board == Board(9, 6, 0.06) and not leftover.exists()


@pytest.mark.parametrize("call", range(1, 5))
def test_a_full_disk_at_any_write_leaves_the_rest_whole(tmp_path, monkeypatch, call):
    recording = GrowingRecording(tmp_path / "r")
    recording.add(recording.reserve(), images("C1", "C2"))
    real, calls = Path.write_bytes, []

    def full(path: Path, data: bytes) -> int:
        calls.append(path)
        if len(calls) == call:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(path, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(CalibrationError, match="the disk is full; 1 frame set of this session kept"):
        recording.add(recording.reserve(), images("C1", "C2"))
    opened = open_recording(tmp_path / "r")
    assert opened.frames == ("000000",) and not list((tmp_path / "r").glob("**/.*.png"))


@pytest.mark.parametrize("call", range(5))
def test_a_full_disk_at_any_line_leaves_the_rest_whole(tmp_path, monkeypatch, call):
    recording = GrowingRecording(tmp_path / "r")
    recording.add(recording.reserve(), images("C1"))
    real, calls = os.write, []

    def full(handle: int, data: bytes) -> int:
        calls.append(data)
        if len(calls) == call + 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(handle, data)

    monkeypatch.setattr("os.write", full)
    with pytest.raises(CalibrationError, match="the disk is full"):
        recording.add(recording.reserve(), images("C1", "C2"))
    monkeypatch.undo()
    opened = open_recording(tmp_path / "r")
    assert list(opened.cameras) == ["C1"] and opened.frames == ("000000",)
    assert list(opened.timestamps_us("C1")) == list(opened.distances_m("C1")) == ["000000"]
    recording.add(recording.reserve(), images("C1", "C2"))
    assert list(open_recording(tmp_path / "r").timestamps_us("C2")) == ["000002"]


def test_lines_are_whole_or_absent(tmp_path, monkeypatch):
    path = tmp_path / "t.csv"
    append_line(path, "a,b", "1,2")
    path.write_text(path.read_text() + "3,")  # cut short by a kill
    append_line(path, "a,b", "5,6")
    assert path.read_text() == "a,b\n1,2\n5,6\n"
    monkeypatch.setattr("os.write", lambda handle, data: 1)  # as a disk that fills up does it
    with pytest.raises(OSError, match="No space left"):
        append_line(path, "a,b", "7,8")
    assert path.read_text() == "a,b\n1,2\n5,6\n"


def test_the_log_keeps_all_sessions(tmp_path):
    log = CaptureLog(tmp_path, "capture x", "test")
    log.set(cameras={"C1": {"serial": "S1"}, "C2": {"serial": None, "usb_path": "1-2"}})
    log.event("C1", "stalled", 1.0)
    log.end("complete", None, {"frame_sets": 1})
    again = CaptureLog(tmp_path, "capture x --append", "test")
    assert again.identities() == {"C1": "S1", "C2": "1-2"} and again.clock_zero_unix_s == log.clock_zero_unix_s
    (tmp_path / "capture.yaml").write_text("format: other\n")
    with pytest.raises(ConfigError, match="Is it the right file"):
        CaptureLog(tmp_path, "capture x", "test")

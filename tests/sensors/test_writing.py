"""From the readers to the disk: nothing is lost while the disk pauses, and what is lost is said."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rgbd_calib.capture.studio import Tally
from rgbd_calib.capture.wave import _Track
from rgbd_calib.io.growing_recording import CameraImages
from rgbd_calib.sensors.frames import RgbdFrame, SensorFrame
from rgbd_calib.sensors.writer import FrameSetWriter

SCRIPTS = Path(__file__).parents[2] / "scripts"
BLANK = np.zeros((4, 4, 3), np.uint8)


class SlowDisk:
    """A recording whose first frame set takes as long as it is told."""

    def __init__(self) -> None:
        self.go_on = threading.Event()
        self.compressed: list[bool] = []
        self.names = 0
        self.finished = 0

    def reserve(self) -> str:
        self.names += 1
        return f"{self.names:06d}"

    def add(self, frame, images, spread_us, compress) -> None:
        self.go_on.wait(30)
        self.compressed.append(compress)


def test_images_are_not_compressed_while_many_wait():
    disk = SlowDisk()
    with FrameSetWriter(disk, max_pending=12) as writer:
        for _ in range(12):
            writer.submit({"C1": CameraImages(BLANK, None)}, 0)
        disk.go_on.set()
    assert disk.compressed == [True] + [False] * 8 + [True] * 3  # the first was begun when it was alone
    assert writer.waited_s < 0.1


def test_frames_that_were_dropped_are_said():
    """The reader's numbers tell how many are missing between two that were written; a camera plugged in again counts anew."""

    def pair(number: int) -> RgbdFrame:
        single = SensorFrame("color", BLANK, 0, 0, 0.0)
        return RgbdFrame("C1", single, single, number / 30, number / 30, number)

    kept: list[RgbdFrame] = []
    readers = [SimpleNamespace(pairs=lambda: kept) for _ in range(2)]
    rig = SimpleNamespace(reader=lambda camera: readers[0])
    written, said = [], []
    studio = SimpleNamespace(
        rig=rig,
        photographer=SimpleNamespace(
            images=lambda alone: {"C1": CameraImages(BLANK, None, round(alone.frames["C1"].color_s * 1e6))}
        ),
        queue=lambda alone, images: written.append(alone.frames["C1"].number),
        note=lambda camera, text: said.append(text),
        tally=Tally(),
    )
    track = _Track("C1", 0.05)
    for numbers in ([1, 2, 3], [2, 3, 4], [9, 10], [12]):
        kept[:] = map(pair, numbers)
        track.write_new(studio)
    assert written == [2, 3, 4, 9, 10, 12] and len(said) == 1
    readers.pop(0)
    kept[:] = [pair(40)]
    track.write_new(studio)
    assert studio.tally.not_written == {
        "C1": [
            {"frames": 4, "after_us": 133_333, "before_us": 300_000},
            {"frames": 1, "after_us": 333_333, "before_us": 400_000},
        ]
    }


def test_two_realsense_and_one_openni2_at_once(redist):
    """What is on the disk is bit by bit what was sent, and each frame that is missing was said to be lost or dropped."""
    pytest.importorskip("pyrealsense2")
    done = subprocess.run(
        [sys.executable, SCRIPTS / "study_mixed_capture.py", "--seconds", "3", "--json"],
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert [own["make"] for own in result["cameras"].values()] == ["RealSense", "RealSense", "OpenNi2"]
    for camera, own in result["cameras"].items():
        assert own["frames"] + len(own["missing"]) > 60
        assert own["differ"] == own["twice"] == 0
        counts = result["said"][camera]
        dropped = sum(gap["frames"] for gap in result["not_written"].get(camera, []))
        assert len(own["missing"]) <= dropped + max(counts["lost"].values()) + max(counts["unpaired"].values())

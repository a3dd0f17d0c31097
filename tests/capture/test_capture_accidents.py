"""Cameras that are unplugged or stall, Ctrl-C, kills and full disks: what `capture` had recorded stays whole."""

from __future__ import annotations

import csv
import os
import signal
import time

import numpy as np
import pytest
from virtual_rig import QUICK, SOURCES, build, check_whole, finish, interrupted, last_session

from rgbd_calib.io.recording import open_recording


def test_unplugged_and_plugged_in_again(rig):
    out, process = rig.capturing(*QUICK)
    rig.command("unplug 1")
    rig.wait_for_text(out / "capture.yaml", "unplugged; the other")
    rig.command("plug 1")
    rig.wait_for_text(out / "capture.yaml", "event: plugged in again")
    n = len(list((out / "C2" / "color").glob("0*.png")))
    deadline = time.monotonic() + 60
    while len(list((out / "C2" / "color").glob("0*.png"))) < n + 2 and time.monotonic() < deadline:
        time.sleep(0.1)
    ended = interrupted(process)
    assert ended.status == 0, ended.stderr
    recording = check_whole(out)
    assert n + 2 <= len(recording.color_files["C2"]) < len(recording.color_files["C1"])
    assert last_session(out)["counts"]["absent"]["C2"] >= 1
    assert "C2: missing in" in ended.stderr


def test_cameras_opened_and_closed_again_and_again(rig):
    """As by `monitor`: the runtime crashes once a thread waits for frames after another one that waited has ended."""
    program = f"""
from pathlib import Path
from rgbd_calib.capture.still_scene import take_snapshots
for _ in range(6):
    print(*take_snapshots(("openni2",), Path({str(rig.redist)!r}), {{}}, {{}}, 2, settle_s=0.1))
"""
    ended = rig.run(python=program)
    assert ended.status == 0, ended.stderr
    assert ended.stdout.splitlines() == ["C1 C2"] * 6


def test_colour_stalls_and_comes_back(rig):
    out, process = rig.capturing(*QUICK)
    rig.command("stall 0 color")
    rig.wait_for_text(out / "capture.yaml", "color stalled")
    rig.command("resume 0 color")
    rig.wait_for_text(out / "capture.yaml", "color delivers again")
    ended = interrupted(process)
    assert ended.status == 0 and "C1: color stalled" in ended.stderr
    check_whole(out)


def test_all_cameras_gone(rig):
    out, process = rig.capturing("--give-up", 2, *QUICK, sets=1)
    rig.command("unplug 0")
    rig.command("unplug 1")
    ended = finish(process)
    assert ended.status == 1 and "no frames for 2 s; what was recorded before is whole" in ended.stderr
    assert last_session(out)["status"] == "failed"
    check_whole(out)


def test_ctrl_c_then_append(rig):
    out, process = rig.capturing(*QUICK)
    ended = interrupted(process)
    assert ended.status == 0 and "ended by Ctrl-C" in ended.stderr
    assert last_session(out)["status"] == "interrupted"
    n = len(check_whole(out).frames)
    assert "exists already" in rig.run("capture", out, "--count", 1).stderr
    assert rig.run("capture", out, "--append", "--count", 2, *QUICK).status == 0
    recording = check_whole(out)
    assert len(recording.frames) == n + 2
    times_us = [t for t, _ in recording.timestamps_us("C1").values()]
    assert times_us == sorted(times_us) and last_session(out)["status"] == "complete"


@pytest.mark.parametrize("seed", range(2))
def test_a_kill_leaves_whole_frame_sets(rig, seed):
    out, process = rig.capturing("--settle", 0.3, "--interval", 0)
    time.sleep(np.random.default_rng(seed).uniform(0, 0.2))
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    with (out / "frame_sets.csv").open() as stream:
        finished = [row["frame"] for row in csv.DictReader(stream)]
    recording = open_recording(out)
    for camera in recording.cameras:
        for frame in finished:
            recording.color(camera, frame)
            recording.depth_m(camera, frame)
    assert last_session(out)["status"] == "running"
    ended = rig.run("capture", out, "--append", "--count", 1, *QUICK)
    assert ended.status == 0, ended.stderr
    assert len(check_whole(out).frames) >= len(finished) + 1


def test_full_disk(rig):
    library = build(SOURCES / "full_disk.cpp", rig.folder / "full_disk.so")
    out = rig.folder / "out"
    rig.environment |= {"LD_PRELOAD": str(library), "FULL_DISK_BYTES": str(4_000_000)}
    ended = rig.run("capture", out, *QUICK)
    assert ended.status == 1 and "the disk is full" in ended.stderr and "--append" in ended.stderr
    del rig.environment["LD_PRELOAD"]
    recording = check_whole(out)
    assert len(recording.frames) >= 1
    assert rig.run("capture", out, "--append", "--count", 1, *QUICK).status == 0

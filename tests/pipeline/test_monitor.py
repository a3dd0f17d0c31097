"""Watching a rig: lines, metrics, drift, failures, and nothing that grows."""

from __future__ import annotations

import json
import os
import shutil
import sys
import threading
import time

import numpy as np
import pytest

from rgbd_calib.cli.options import progress
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.rig import read_rig
from rgbd_calib.pipeline.monitor import FolderSource, MonitorParams, metrics, watch
from rgbd_calib.pipeline.snapshot import prepare
from rgbd_calib.simulation.changes import SceneChange
from rgbd_calib.simulation.params import SimulationParams
from rgbd_calib.simulation.snapshot import simulate_snapshots
from rgbd_calib.trust.snapshot import Before

TWIST = np.array([0.0, 0.01, 0.0, 0.01, 0.0, 0.0])


@pytest.fixture(scope="module")
def bumped(tmp_path_factory):
    out = tmp_path_factory.mktemp("bumped")
    params = SimulationParams(cameras=2, width=240, height=180, seed=6)
    simulate_snapshots(out, params, SceneChange({"C2": TWIST}), 4, 1, progress)
    return out


def test_drift_ends_it_with_status_1_and_is_in_the_metrics(run, bumped, tmp_path):
    prom = tmp_path / "rig.prom"
    rig, old = bumped / "truth.yaml", bumped / "old"
    args = ("monitor", rig, bumped / "new", "--snapshot", old, "--every", "0", "--confirm", "1", "--rounds", "3")
    result = run(*args, "--json", "--metrics", prom)
    assert result.status == 1
    (line,) = result.stdout.splitlines()
    told = json.loads(line)
    assert told["status"] == "moved" and told["drift"] and told["moved"] == ["C2"] and told["round"] == 1
    text = prom.read_text()
    assert 'rgbd_calib_camera_moved{camera="C2"} 1' in text and 'rgbd_calib_camera_moved{camera="C1"} 0' in text
    assert "# TYPE rgbd_calib_rig_holds gauge" in text and "rgbd_calib_rig_holds 0" in text


def test_a_rig_that_holds_goes_on_and_old_images_are_no_new_round(run, bumped, tmp_path):
    rig, old = bumped / "truth.yaml", bumped / "old"
    live = shutil.copytree(old, tmp_path / "live")
    result = run("monitor", rig, live, "--snapshot", old, "--every", "0", "--rounds", "2")
    assert result.status == 0
    first, second = result.stdout.splitlines()
    assert " holds: C1 0." in first and "failed: no new images" in second


def test_the_command_of_on_drift_gets_the_line_once_and_watching_goes_on(run, bumped, tmp_path):
    live, log = tmp_path / "live", tmp_path / "log"
    shutil.copytree(bumped / "new", live)
    script = tmp_path / "told.py"
    script.write_text(f"import sys; open({str(log)!r}, 'a').write(sys.stdin.read() + chr(10))")
    rig, old = bumped / "truth.yaml", bumped / "old"
    stop = threading.Event()

    def touch() -> None:
        while not stop.wait(0.02):
            os.utime(live / "C1" / "color" / "000000.png")

    toucher = threading.Thread(target=touch)
    toucher.start()
    try:
        args = ("monitor", rig, live, "--snapshot", old, "--every", "0.1", "--confirm", "2", "--rounds", "4")
        result = run(*args, "--on-drift", f"{sys.executable} {script}")
    finally:
        stop.set()
        toucher.join()
    assert result.status == 1 and len(result.stdout.splitlines()) == 4
    assert [json.loads(text)["moved"] for text in log.read_text().splitlines()] == [["C2"]]


def test_a_round_that_fails_is_told_and_the_next_one_follows(bumped, tmp_path):
    rig = read_rig(bumped / "truth.yaml")
    before = prepare(rig, open_recording(bumped / "old"))
    live = tmp_path / "live"
    source = FolderSource(live, tuple(before), 4)
    rounds = []
    for each in watch(rig, before, source, MonitorParams(0.0, rounds=3), lambda _: False):
        rounds.append(each)
        if each.number == 1:
            shutil.copytree(bumped / "old", live)
            (live / "C1" / "depth" / "000003.png").write_bytes(b"half")
        elif each.number == 2:
            shutil.copy(bumped / "old" / "C1" / "depth" / "000003.png", live / "C1" / "depth" / "000003.png")
    assert [each.status for each in rounds] == ["failed", "failed", "holds"]
    assert "no such folder" in rounds[0].problem and "000003.png" in rounds[1].problem
    assert "rgbd_calib_monitor_failures_total 2" in metrics(rounds[0], 2)


def test_a_passing_person_is_no_drift(bumped):
    rig = read_rig(bumped / "truth.yaml")
    before = prepare(rig, open_recording(bumped / "old"))
    snapshots = {s: FolderSource(bumped / s, tuple(before), 4)() for s in ("old", "new")}
    sequence = iter(["new", "new", "old", "new", "new", "new"])
    params = MonitorParams(0.0, confirm=3, rounds=6)
    drift = [each.drift for each in watch(rig, before, lambda: snapshots[next(sequence)], params, lambda _: False)]
    assert drift == [False] * 5 + [True]


def test_it_stops_where_the_pause_says_so(bumped):
    rig = read_rig(bumped / "truth.yaml")
    pauses = []

    def pause(seconds: float) -> bool:
        pauses.append(seconds)
        return len(pauses) == 2

    before: dict[str, Before] = {}
    assert len(list(watch(rig, before, lambda: {}, MonitorParams(60.0), pause))) == 2
    assert 59 < pauses[0] <= 60


def test_from_cameras_and_a_snapshot_captured_from_them(run, bumped, tmp_path):
    played, out = f"replay:{bumped / 'old'}", tmp_path / "empty"
    captured = run("capture", out, "--snapshot", "--driver", played, "--settle", "0.1", "--depth-frames", "5")
    assert captured.status == 0, captured.stderr
    assert len(open_recording(out).frames) == 1
    rig = bumped / "truth.yaml"
    result = run(
        "monitor", rig, "--snapshot", out, "--driver", played, "--every", "0", "--rounds", "1", "--frames", "3"
    )
    assert result.status == 0 and " holds: " in result.stdout, result.stdout + result.stderr
    refused = run("capture", tmp_path / "x", "--snapshot", "--intrinsic")
    assert refused.status == 2 and "--snapshot" in refused.stderr
    assert run("monitor", rig, bumped / "new", "--driver", played).status == 2


@pytest.mark.slow
def test_nothing_grows(bumped):
    """Memory and descriptors over 80 rounds."""
    rig = read_rig(bumped / "truth.yaml")
    before = prepare(rig, open_recording(bumped / "old"))
    source = FolderSource(bumped / "new", tuple(before), 2)

    def every_time():
        source._seen = None
        return source()

    sizes, descriptors = [], []
    for _ in watch(rig, before, every_time, MonitorParams(0.0, rounds=80), lambda _: False):
        with open("/proc/self/statm") as file:
            sizes.append(int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6)
        descriptors.append(len(os.listdir("/proc/self/fd")))
        time.sleep(0)
    assert descriptors[-1] == descriptors[20]
    assert np.median(sizes[-20:]) - np.median(sizes[20:40]) < 5

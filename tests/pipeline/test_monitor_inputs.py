"""What a monitor writes replaces nothing of others, and a comparison of images with themselves is refused."""

import os
import shutil

import pytest

from rgbd_calib.pipeline.detection import silent
from rgbd_calib.simulation.changes import SceneChange
from rgbd_calib.simulation.params import SimulationParams
from rgbd_calib.simulation.snapshot import simulate_snapshots


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    out = tmp_path_factory.mktemp("still")
    simulate_snapshots(out, SimulationParams(cameras=2, width=160, height=120, seed=6), SceneChange({}), 2, 1, silent)
    return out


@pytest.fixture
def monitor(run, still, tmp_path):
    shutil.copy(still / "truth.yaml", tmp_path / "rig.yaml")
    args = (
        "monitor",
        tmp_path / "rig.yaml",
        still / "new",
        "--snapshot",
        still / "old",
        "--rounds",
        "1",
        "--every",
        "0",
    )
    return lambda *more: run(*args, *more)


def test_metrics_replace_no_file_of_others(monitor, tmp_path):
    rig, other = tmp_path / "rig.yaml", tmp_path / "letter.txt"
    other.write_text("mine")
    os.mkfifo(tmp_path / "pipe")
    for path in (rig, other, tmp_path / "pipe", "/dev/full"):
        before = rig.read_bytes()
        refused = monitor("--metrics", path)
        assert refused.status == 2 and refused.stdout == "" and str(path) in refused.stderr
        assert rig.read_bytes() == before and other.read_text() == "mine"


def test_metrics_of_an_earlier_monitor_are_replaced(monitor, tmp_path):
    for _ in range(2):
        monitor("--metrics", tmp_path / "rig.prom")
        assert (tmp_path / "rig.prom").read_text().startswith("# HELP rgbd_calib_monitor_")


def test_a_log_is_appended_to_logs_alone(monitor, run, tmp_path):
    rig = tmp_path / "rig.yaml"
    before = rig.read_bytes()
    os.mkfifo(tmp_path / "pipe")
    for path in (rig, tmp_path / "pipe"):
        refused = monitor("--log-file", path)
        assert refused.status == 2 and "expected" in refused.stderr
    assert rig.read_bytes() == before
    for _ in range(2):
        assert run("report", tmp_path / "none.yaml", "-o", tmp_path / "x", "--log-file", tmp_path / "log").status == 2
    assert len((tmp_path / "log").read_text().splitlines()) == 2
    assert monitor("--log-file", os.devnull).status in (0, 1)


def test_no_comparison_is_no_success(run, still, tmp_path):
    args = (
        "monitor",
        still / "truth.yaml",
        tmp_path / "none",
        "--snapshot",
        still / "old",
        "--rounds",
        "2",
        "--every",
        "0",
    )
    ended = run(*args)
    assert ended.status == 1 and "none of 2 round(s) gave a comparison" in ended.stderr


def test_a_snapshot_compared_with_itself_is_told(run, still):
    rig, old = still / "truth.yaml", still / "old"
    for args in (("monitor", rig, old, "--rounds", "1"), ("verify", rig, old)):
        same = run(*args, "--snapshot", old)
        assert same.status == 0 and "is the old snapshot itself" in same.stderr

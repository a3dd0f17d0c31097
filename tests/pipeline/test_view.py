"""The viewer's file holds every camera, cloud and image; errors come before any work."""

import builtins
import contextlib
import re
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest


def contents(path):
    """Entity paths in a .rrd file, and the rows logged for each."""
    chunk = pytest.importorskip("rerun.chunk")
    rows: dict[str, int] = {}
    for part in chunk.RrdReader(str(path)).stream():
        rows[str(part.entity_path)] = rows.get(str(part.entity_path), 0) + part.num_rows
    return rows


@pytest.fixture(autouse=True)
def _viewer():
    pytest.importorskip("rerun", reason="the extra 'view' is not installed")


def test_a_rig_alone(run, tiny, tmp_path):
    outcome = run("view", tiny.rig_path, "--save", tmp_path / "rig.rrd")
    assert outcome.status == 0, outcome.stderr
    rows = contents(tmp_path / "rig.rrd")
    assert {f"/world/cameras/{name}/image" for name in ("C1", "C2", "C3")} <= set(rows)
    assert not any("clouds" in path for path in rows)


def test_a_rig_with_its_recording(run, tiny, tmp_path):
    outcome = run("view", tiny.rig_path, tiny.recording, "--save", tmp_path / "rig.rrd")
    assert outcome.status == 0, outcome.stderr
    rows = contents(tmp_path / "rig.rrd")
    # C1 has depth in both frames, C2 in one, C3 in none; images: the pinhole, and two frames
    assert rows["/world/clouds/C1"] == 2 and rows["/world/clouds/C2"] == 1
    assert "/world/clouds/C3" not in rows
    assert [rows[f"/world/cameras/{name}/image"] for name in ("C1", "C2", "C3")] == [3, 3, 3]


def test_one_frame(run, tiny, tmp_path):
    args = (
        "view",
        tiny.rig_path,
        tiny.recording,
        "--frame",
        "000001",
        "--color",
        "image",
        "--save",
        tmp_path / "a.rrd",
    )
    assert run(*args).status == 0
    rows = contents(tmp_path / "a.rrd")
    assert rows["/world/clouds/C1"] == 1 and "/world/clouds/C2" not in rows
    assert run(*args).status == 2


@pytest.mark.parametrize(
    ("args", "needle"),
    [
        (("--save", "a.rrd", "--serve"), "one of them"),
        (("--frame", "000000", "--save", "a.rrd"), "without a recording"),
    ],
)
def test_options_that_do_not_go_together(run, tiny, tmp_path, monkeypatch, args, needle):
    monkeypatch.chdir(tmp_path)
    outcome = run("view", tiny.rig_path, *args)
    assert outcome.status == 2 and needle in outcome.stderr
    assert list(tmp_path.iterdir()) == []


def test_without_the_viewer_the_error_says_how_to_install_it(run, tiny, tmp_path, monkeypatch):
    real = builtins.__import__

    def without_rerun(name, *args, **kwargs):
        if name == "rerun":
            raise ImportError("No module named 'rerun'")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_rerun)
    outcome = run("view", tiny.rig_path, "--save", tmp_path / "a.rrd")
    assert outcome.status == 2 and "pip install rgbd-calib[view]" in outcome.stderr
    assert list(tmp_path.iterdir()) == []


def test_points_are_where_fuse_puts_them(run, tiny, tmp_path):
    chunk = pytest.importorskip("rerun.chunk")
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.pipeline.fuse import clouds_of

    args = ("--frame", "000000", "--stride", "1", "--save", tmp_path / "a.rrd")
    assert run("view", tiny.rig_path, tiny.recording, *args).status == 0
    wanted_m = clouds_of(open_recording(tiny.recording), tiny.rig, "000000")[0].points_m
    for part in chunk.RrdReader(str(tmp_path / "a.rrd")).stream():
        if str(part.entity_path) == "/world/clouds/C1":
            batch = part.to_record_batch()
            column = next(name for name in batch.schema.names if "positions" in name)
            seen_m = np.array(batch.column(column)[0].as_py())
            assert np.abs(seen_m - wanted_m).max() < 1e-6  # float32 of 2 m
            return
    pytest.fail("no cloud of C1")


SERVE = """
import signal, sys
from rgbd_calib.report import viewer
from rgbd_calib.cli.main import main
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where the tests run in the background
viewer.WEB_PORT, viewer.DATA_PORT = map(int, sys.argv[1:3])
sys.argv = ["rgbd-calib", *sys.argv[3:]]
main()
"""


LISTENING = "0A"


def free_ports(n: int) -> list[int]:
    with contextlib.ExitStack() as stack:
        made = [stack.enter_context(socket.socket()) for _ in range(n)]
        for s in made:
            s.bind(("127.0.0.1", 0))
        return [s.getsockname()[1] for s in made]


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc/net")
def test_served_to_this_computer_alone(tiny):
    web, data = free_ports(2)
    args = map(str, (web, data, "view", tiny.rig_path, "--serve"))
    with subprocess.Popen([sys.executable, "-c", SERVE, *args], stderr=subprocess.PIPE, text=True) as process:
        try:
            url = next(found[1] for line in process.stderr if (found := re.search(r"Open \S+\?url=(\S+rrd)\.", line)))
            with urllib.request.urlopen(url) as answer:
                origin = answer.headers["Access-Control-Allow-Origin"]
                assert answer.read(4) == b"RRF2" and origin == f"http://127.0.0.1:{web}"
            with pytest.raises(urllib.error.HTTPError, match="403") as refused:
                urllib.request.urlopen(f"http://127.0.0.1:{data}/rig.rrd")
            refused.value.close()
            places = [
                line.split()[1]
                for table in ("/proc/net/tcp", "/proc/net/tcp6")
                for line in Path(table).read_text().splitlines()[1:]
                if line.split()[3] == LISTENING
            ]
            wanted = tuple(f":{port:04X}" for port in (web, data))
            seen = [place for place in places if place.endswith(wanted)]
            assert len(seen) == 2 and all(place.startswith("0100007F:") for place in seen)
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 130

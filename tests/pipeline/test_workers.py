"""Work given to processes and to a Dask cluster: the same results in the same order, whoever dies on the way."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from dask_cluster import wait_for
from small_recording import draw_recording

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.pipeline.workers import AHEAD, FEW, Ready, Workers


def square(x):
    return x * x


def refuse(x):
    if x == 15:
        raise ConfigError(f"number {x}: not liked")
    return x


def process(x):
    return os.getpid()


def die_once(job):
    """Kills its process the first time that it sees the number 20."""
    mark, x = job
    if x == 20 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return x * x


def die_always(x):
    if x == 20:
        os._exit(1)
    return x


def wait_here(job):
    folder, x = job
    if x < FEW:
        return
    (folder / str(os.getpid())).touch()
    time.sleep(60)


@pytest.mark.parametrize("jobs", [1, 3])
def test_results_come_in_order_and_little_is_out_at_a_time(jobs):
    drawn = []

    def work():
        for x in range(100):
            drawn.append(x)
            yield Ready(-x) if x % 10 == 0 else x

    got = []
    for result in Workers(jobs).in_order(square, work()):
        got.append(result)
        assert len(drawn) - len(got) <= AHEAD * jobs + FEW
    assert got == [-x if x % 10 == 0 else x * x for x in range(100)]


def test_one_job_is_this_process_and_known_results_start_none():
    assert set(Workers(1).in_order(process, range(3))) == {os.getpid()}
    assert set(Workers(2).in_order(process, range(FEW))) == {os.getpid()}  # done before others would have started
    pids = list(Workers(2).in_order(process, range(FEW + 9)))
    assert set(pids[:FEW]) == {os.getpid()} and os.getpid() not in pids[FEW:]
    assert list(Workers(2).in_order(die_always, (Ready(20) for _ in range(30)))) == [20] * 30


@pytest.mark.parametrize("jobs", [1, 2])
def test_the_first_error_is_the_same_whoever_is_fastest(jobs):
    with pytest.raises(ConfigError, match="number 15: not liked"):
        list(Workers(jobs).in_order(refuse, range(30)))


def test_a_killed_process_loses_nothing(tmp_path):
    said = []
    work = ((tmp_path / "mark", x) for x in range(40))
    assert list(Workers(2, say=said.append).in_order(die_once, work)) == [x * x for x in range(40)]
    assert len(said) == 1 and "died" in said[0]


def test_what_kills_every_process_is_named():
    with pytest.raises(CalibrationError, match=r"^20: the process that works on it dies, even alone"):
        list(Workers(2).in_order(die_always, range(30)))


def test_workers_end_with_a_parent_that_was_killed(tmp_path):
    code = (
        "import sys; sys.path[:0] = sys.argv[1:3]; from pathlib import Path; import test_workers as t\n"
        "list(t.Workers(2).in_order(t.wait_here, [(Path(sys.argv[3]), x) for x in range(t.FEW + 2)]))"
    )
    here = Path(__file__).parent
    parent = subprocess.Popen([sys.executable, "-c", code, here, here.parent / "builders", tmp_path])
    try:
        wait_for(lambda: len(list(tmp_path.iterdir())) == 2)
    finally:
        parent.kill()
        parent.wait()
    workers = [int(path.name) for path in tmp_path.iterdir()]
    wait_for(lambda: not any(alive(pid) for pid in workers))


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
    except OSError:
        return False


def test_a_cluster_does_the_same(cluster):
    workers = Workers(dask=cluster.address)
    assert list(workers.in_order(square, (Ready(-1) if x == 7 else x for x in range(40)))) == [
        -1 if x == 7 else x * x for x in range(40)
    ]
    with pytest.raises(ConfigError, match="number 15: not liked"):
        list(workers.in_order(refuse, range(30)))


def test_a_cluster_without_the_program_is_said(cluster, tmp_path, monkeypatch):
    (tmp_path / "unknown_there.py").write_text("def work(x):\n    return x\n")
    monkeypatch.syspath_prepend(tmp_path)
    import unknown_there

    with pytest.raises(ConfigError, match="its scheduler and every worker need rgbd-calib"):
        list(Workers(dask=cluster.address).in_order(unknown_there.work, range(3)))


def test_a_killed_worker_of_a_cluster_changes_nothing(cluster, tmp_path, run):
    """Detection on a cluster, a worker killed in the middle: the table is that of one process here."""
    folder = draw_recording(tmp_path / "recording", 3, 8)
    assert run("detect", folder, "-o", tmp_path / "here.csv", "--jobs", 1, "--no-cache").status == 0
    command = [sys.executable, "-m", "rgbd_calib", "detect", "recording", "--dask", cluster.address, "-o", "there.csv"]
    environment = os.environ | {"RGBD_CALIB_CACHE": str(tmp_path / "cache")}
    started = subprocess.Popen(command, cwd=tmp_path, env=environment)
    wait_for(lambda: len(list((tmp_path / "cache").rglob("?" * 64))) >= 4)
    cluster.workers.pop().kill()
    assert started.wait(120) == 0
    cluster.workers.append(cluster.start_worker())
    assert (tmp_path / "there.csv").read_bytes() == (tmp_path / "here.csv").read_bytes()


def test_a_recording_that_the_workers_do_not_see(cluster, tmp_path, monkeypatch):
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.pipeline.config import Config
    from rgbd_calib.pipeline.detection import detect
    from rgbd_calib.pipeline.doctor import examine
    from rgbd_calib.views.detect import DetectParams

    opened = open_recording(draw_recording(tmp_path / "recording", 2, 1))
    files = {c: {f: Path("/nowhere") / p.name for f, p in files.items()} for c, files in opened.color_files.items()}
    elsewhere = replace(opened, listed={"color": files, "depth": opened.depth_files, "ir": opened.ir_files})
    with pytest.raises(ConfigError, match="under the same path"):
        detect(elsewhere, DetectParams(), Workers(dask=cluster.address))
    with pytest.raises(ConfigError, match="under the same path"):  # not images that are damaged
        examine(elsewhere, Config(), workers=Workers(dask=cluster.address))


def test_workers_with_another_detector_are_refused(cluster, tmp_path, monkeypatch):
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.pipeline import detection
    from rgbd_calib.views.detect import DetectParams

    monkeypatch.setattr(detection, "detector", lambda: "another OpenCV")
    with pytest.raises(ConfigError, match="the same are needed for the same result"):
        detection.detect(
            open_recording(draw_recording(tmp_path / "recording", 2, 1)), DetectParams(), Workers(dask=cluster.address)
        )


def test_no_cluster_is_said(tiny, run, tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="pip install 'rgbd-calib[dask]'")
    monkeypatch.setattr("rgbd_calib.pipeline.dask_workers.CONNECT_S", 0.5)
    outcome = run("detect", tiny.recording, "-o", tmp_path / "corners.csv", "--dask", "tcp://127.0.0.1:9")
    assert outcome.status == 2 and "no Dask scheduler answers there" in outcome.stderr
    outcome = run("detect", tiny.recording, "-o", tmp_path / "corners.csv", "--dask", "nonsense")
    assert outcome.status == 2 and "no Dask scheduler answers there" in outcome.stderr
    outcome = run("detect", tiny.recording, "-o", tmp_path / "c.csv", "--dask", "tcp://127.0.0.1:9", "--jobs", 2)
    assert outcome.status == 2 and "--jobs goes without --dask" in outcome.stderr
    monkeypatch.setitem(sys.modules, "distributed", None)
    outcome = run("detect", tiny.recording, "-o", tmp_path / "corners.csv", "--dask", "tcp://127.0.0.1:9")
    assert outcome.status == 2 and "rgbd-calib[dask]" in outcome.stderr

"""Standard output holds results alone, and a reader that goes away changes neither the work nor the exit status."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no such pipes")

ROOT = Path(__file__).parents[2]
CHATTER = """
import os, sys
import rgbd_calib.io.recording as m
real = m.open_recording
def loud(path):
    print("by Python")
    os.write(1, b"by C\\n")
    os.system("echo by a child")
    return real(path)
m.open_recording = loud
from rgbd_calib.cli.main import main
sys.argv[0] = "rgbd-calib"
main()
"""


def start(*args: object, script: str | None = None, **options) -> subprocess.Popen[str]:
    command = [sys.executable, *(("-c", script) if script else ("-m", "rgbd_calib")), *map(str, args)]
    return subprocess.Popen(
        command, env=os.environ | {"PYTHONPATH": str(ROOT)}, stderr=subprocess.PIPE, text=True, **options
    )


def finish(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=120)
    return process.returncode, out or "", err


def test_what_libraries_print_is_not_among_the_results(tiny):
    process = start("doctor", tiny.recording, "--json", script=CHATTER, stdout=subprocess.PIPE)
    _, out, err = finish(process)
    assert "findings" in json.loads(out)
    assert all(f"by {who}\n" in err for who in ("Python", "C", "a child"))


@pytest.mark.parametrize("args", [("--help",), ("schema",), ("schema", "rig"), ("export", "--help")])
def test_a_reader_that_goes_away(args):
    read, write = os.pipe()
    os.close(read)
    process = start(*args, stdout=write)
    os.close(write)
    assert finish(process) == (0, "", "")


def test_the_work_is_finished_for_nobody(tiny, tmp_path):
    """Both streams lead to a reader that went away; the files are written."""
    read, write = os.pipe()
    os.close(read)
    args = ("correct", tiny.recording, "--rig", tiny.rig_path, "-o", tmp_path / "out")
    command = [sys.executable, "-m", "rgbd_calib", *map(str, args)]
    ended = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=write, stderr=write, check=False, timeout=120
    )
    os.close(write)
    assert ended.returncode == 0 and (tmp_path / "out" / "dataset.yaml").exists()


def test_a_failure_stays_a_failure_for_nobody(tmp_path):
    read, write = os.pipe()
    os.close(read)
    process = start("doctor", tmp_path / "nothing", stdout=write)
    os.close(write)
    status, _, err = finish(process)
    assert status == 2 and "no such folder" in err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_results_that_are_lost_are_an_error():
    with open("/dev/full", "w") as full:
        status, _, err = finish(start("schema", "rig", stdout=full))
    assert status == 2 and "standard output" in err and "Traceback" not in err


@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&-", "<&-"])
def test_closed_streams(tiny, tmp_path, closed):
    """The next file that is opened is then not taken for a stream."""
    out = tmp_path / "out.json"
    line = f'"{sys.executable}" -m rgbd_calib export "{tiny.rig_path}" --to json "{out}" {closed}'
    ended = subprocess.run(["sh", "-c", line], env=os.environ | {"PYTHONPATH": str(ROOT)}, check=False, timeout=120)
    assert ended.returncode == 0 and "cameras" in json.loads(out.read_text())

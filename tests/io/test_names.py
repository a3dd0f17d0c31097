"""Names that are no UTF-8, hold control characters, or are too long: kept apart from terminals and readers, never a traceback."""

from __future__ import annotations

import json
import os
import shutil
import sys
from pathlib import Path

import pytest

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.files import load_yaml, whole_folder, write_text
from rgbd_calib.io.rig import read_rig
from rgbd_calib.io.text import printable, valid

BAD = os.fsdecode(b"caf\xe9")

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="other systems have names of Unicode only")


@pytest.mark.parametrize(
    ("text", "wanted"), [("plain 目", "plain 目"), (BAD, r"caf\xe9"), ("\ud800", r"\ud800"), ("a\nb", "a\nb")]
)
def test_text_that_is_valid(text, wanted):
    assert valid(text) == wanted
    valid(text).encode()


def test_what_a_terminal_shows():
    assert printable(f"{BAD}\n\x1b[2J\u202e") == "caf\\xe9\n\\x1b[2J\\u202e"


@pytest.fixture
def drawn(tmp_path: Path, tiny) -> Path:
    shutil.copytree(tiny.recording, tmp_path / BAD)
    return tmp_path / BAD


def test_a_recording_and_outputs_of_such_names(run, tiny, tmp_path, drawn):
    out = tmp_path / f"out{BAD}"
    assert run("correct", drawn, "--rig", tiny.rig_path, "-o", out).status == 0
    assert run("correct", drawn, "--rig", tiny.rig_path, "-o", out, "--overwrite").status == 0
    assert read_rig(out / "rig.yaml").cameras.keys() == tiny.rig.cameras.keys()
    told = run("fuse", drawn, "--rig", tiny.rig_path, "-o", tmp_path / f"{BAD}.ply")
    assert told.status == 0 and r"caf\xe9" in told.stderr and (tmp_path / f"{BAD}.ply").exists()
    told = run("export", tiny.rig_path, "--to", "json", tmp_path / f"{BAD}.json")
    assert told.status == 0
    json.loads((tmp_path / f"{BAD}.json").read_text())
    shutil.copy(tiny.rig_path, tmp_path / f"{BAD}.yaml")
    told = run("report", tmp_path / f"{BAD}.yaml", "-o", tmp_path / "report")
    assert told.status == 0, told.stderr
    assert r"caf\xe9.yaml" in (tmp_path / "report" / "index.html").read_text(encoding="utf-8")


def test_what_is_written_of_such_a_name_is_read_back(tmp_path):
    from rgbd_calib.io.files import dump_yaml

    write_text(tmp_path / "a.yaml", dump_yaml({"recording": BAD, BAD: [Path(BAD)]}))
    assert load_yaml(tmp_path / "a.yaml") == {"recording": r"caf\xe9", r"caf\xe9": [r"caf\xe9"]}


def test_text_of_another_make_is_refused_before_it_is_written(tmp_path):
    with pytest.raises(ConfigError, match=r"a\.txt: cannot be written as UTF-8, a name holds \\xe9"):
        write_text(tmp_path / "a.txt", BAD)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "args", [("doctor", BAD), (BAD,), ("schema", BAD), ("export", BAD, "--to", "json", "a.json")], ids=str
)
def test_errors_name_them_in_text_that_a_terminal_takes(run, tmp_path, monkeypatch, args):
    monkeypatch.chdir(tmp_path)
    outcome = run(*args)
    assert outcome.status == 2 and r"caf\xe9" in outcome.stderr and "Traceback" not in outcome.stderr


def test_a_name_cannot_command_the_terminal(run, tmp_path):
    outcome = run("doctor", tmp_path / "a\x1b[2Jb")
    assert outcome.status == 2 and "\x1b" not in outcome.stderr and r"a\x1b[2Jb" in outcome.stderr


def test_long_names(run, tiny, tmp_path):
    for name in ("x" * 250, "目" * 83):  # 255 and 254 bytes with the suffix, the longest that the disk takes
        assert run("export", tiny.rig_path, "--to", "json", tmp_path / f"{name}.json").status == 0
        with whole_folder(tmp_path / name[:250], overwrite=True):
            pass
    outcome = run("export", tiny.rig_path, "--to", "json", tmp_path / f"{'x' * 300}.json")
    assert outcome.status == 2 and "File name too long" in outcome.stderr

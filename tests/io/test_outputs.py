"""Nothing that belongs to somebody else is replaced: folders of others, devices and pipes, and a command's own inputs."""

from __future__ import annotations

import os
import shutil
import socket
import stat
from pathlib import Path

import pytest

from rgbd_calib.errors import ConfigError
from rgbd_calib.io import folders
from rgbd_calib.io.conflicts import refuse_input
from rgbd_calib.io.files import whole_folder, write_text
from rgbd_calib.io.folders import MARKER

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")


def tree(folder: Path) -> list[str]:
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*"))


@pytest.fixture(params=[True, False], ids=["exchange", "two renames"])
def exchange(request, monkeypatch):
    """Both ways of putting the new folder in the place of the old one."""
    if not request.param:
        monkeypatch.setattr(folders, "_exchange", lambda a, b: False)


def write(path: Path, **content: str) -> None:
    with whole_folder(path, overwrite=True) as made:
        for name, text in content.items():
            (made / name).write_text(text)


@pytest.mark.parametrize("args", [("export", "--to", "ros"), ("correct",), ("simulate",), ("import",)])
def test_a_folder_of_somebody_else_is_not_replaced(run, tiny, tmp_path, args):
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "thesis.tex").write_text("thesis")
    (tmp_path / "bag.bag").touch()
    docs = tmp_path / "docs"
    outcome = {
        "export": lambda: run("export", tiny.rig_path, "--to", "ros", docs, "--overwrite"),
        "correct": lambda: run("correct", tiny.recording, "--rig", tiny.rig_path, "-o", docs, "--overwrite"),
        "simulate": lambda: run("simulate", docs, "--overwrite"),
        "import": lambda: run("import", tmp_path / "bag.bag", "-o", docs, "--overwrite"),
    }[args[0]]()
    assert outcome.status == 2 and "one with thesis.tex was found" in outcome.stderr
    assert tree(docs) == ["thesis.tex"]


@pytest.mark.usefixtures("exchange")
def test_of_an_own_folder_only_own_files_are_replaced(run, tiny, tmp_path):
    out = tmp_path / "out"
    assert run("export", tiny.rig_path, "--to", "colmap", out).status == 0
    before = tree(out)
    (out / "notes.txt").write_text("mine")
    (out / "more").mkdir()
    (out / "more" / "link").symlink_to(tmp_path)
    outcome = run("export", tiny.rig_path, "--to", "colmap", out, "--overwrite")
    assert outcome.status == 0 and "are kept: more/, more/link, notes.txt" in outcome.stderr
    assert tree(out) == sorted([*before, "more", "more/link", "notes.txt"])
    assert (out / "notes.txt").read_text() == "mine" and (out / "more" / "link").is_symlink()
    # what another format wrote goes, what is somebody's stays
    assert run("export", tiny.rig_path, "--to", "ros", out, "--overwrite").status == 0
    assert "cameras.txt" not in tree(out) and "more/link" in tree(out)


def test_a_new_file_does_not_replace_one_of_somebody_else_in_an_own_folder(tmp_path):
    write(tmp_path / "out", a="1")
    (tmp_path / "out" / "b").write_text("somebody's")
    with pytest.raises(ConfigError, match="out/b: not written by rgbd-calib"):
        write(tmp_path / "out", a="2", b="2")
    assert (tmp_path / "out" / "a").read_text() == "1" and (tmp_path / "out" / "b").read_text() == "somebody's"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("text", ["", "{}", '{"format": "rgbd-calib/output", "names": [1]}', "[" * 100_000, "[]"])
def test_a_marker_of_another_make_marks_nothing(tmp_path, text):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / MARKER).write_text(text)
    with pytest.raises(ConfigError, match="not replaced"):
        write(tmp_path / "out", a="1")


def test_a_marker_names_nothing_outside(tmp_path):
    """A marker that somebody made lists files above the folder; only what lies in the folder is ever touched."""
    (tmp_path / "precious").write_text("precious")
    write(tmp_path / "out", a="1")
    (tmp_path / "out" / MARKER).write_text('{"format": "rgbd-calib/output", "names": ["../precious", "/etc/hostname"]}')
    write(tmp_path / "out", b="2")
    assert (tmp_path / "precious").read_text() == "precious"


def make_pipe(path: Path) -> None:
    os.mkfifo(path)


def make_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))


def make_device(path: Path) -> None:
    try:
        os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, 3))  # /dev/null
    except PermissionError:
        path.symlink_to("/dev/null")


@pytest.mark.parametrize("make", [make_pipe, make_socket, make_device])
def test_what_is_no_regular_file_is_not_replaced(run, tiny, tmp_path, monkeypatch, make):
    monkeypatch.chdir(tmp_path)  # names of sockets have 108 bytes at most
    make(Path("out.json"))
    before = Path("out.json").stat()
    outcome = run("export", tiny.rig_path, "--to", "json", "out.json", "--overwrite")
    assert outcome.status == 2 and "is in the way" in outcome.stderr
    with pytest.raises(ConfigError, match="is in the way"):
        write_text(Path("out.json"), "{}")
    assert Path("out.json").stat().st_ino == before.st_ino
    outcome = run("export", tiny.rig_path, "--to", "ros", "out.json/", "--overwrite")
    assert outcome.status == 2 and Path("out.json").stat().st_ino == before.st_ino


def test_a_link_is_written_through(run, tiny, tmp_path):
    (tmp_path / "real.json").write_text("old")
    (tmp_path / "link.json").symlink_to("real.json")
    (tmp_path / "real.json").chmod(0o640)
    assert run("export", tiny.rig_path, "--to", "json", tmp_path / "link.json", "--overwrite").status == 0
    assert (tmp_path / "link.json").is_symlink() and "cameras" in (tmp_path / "real.json").read_text()
    assert stat.S_IMODE((tmp_path / "real.json").stat().st_mode) == 0o640


def same(path: Path) -> Path:
    return path


def hard_link(path: Path) -> Path:
    os.link(path, path.with_name("hard.yaml"))
    return path.with_name("hard.yaml")


def soft_link(path: Path) -> Path:
    path.with_name("soft.yaml").symlink_to(path.name)
    return path.with_name("soft.yaml")


@pytest.mark.parametrize("other_name", [same, hard_link, soft_link])
def test_an_output_that_is_an_input_is_refused(run, tiny, tmp_path, other_name):
    given = tmp_path / "given.yaml"
    shutil.copy(tiny.rig_path, given)
    args = ("calibrate", tiny.recording, "--intrinsics", given, "-o", other_name(given), "--overwrite")
    outcome = run(*args)
    assert outcome.status == 2 and "is also the input" in outcome.stderr
    assert given.read_bytes() == tiny.rig_path.read_bytes()


@pytest.mark.parametrize("part", ["dataset.yaml", "C1/color/000000.png", "C1/depth/000000.png"])
def test_a_file_of_the_recording_is_not_replaced(run, tiny, tmp_path, part):
    shutil.copytree(tiny.recording, tmp_path / "in")
    (tmp_path / "link").symlink_to(tmp_path / "in" / part)
    before = (tmp_path / "in" / part).read_bytes()
    for output in (tmp_path / "in" / part, tmp_path / "link"):
        outcome = run("calibrate", tmp_path / "in", "-o", output, "--overwrite")
        assert outcome.status == 2 and "is a part of the input" in outcome.stderr
    assert (tmp_path / "in" / part).read_bytes() == before


def test_an_image_of_a_recording_of_another_layout_is_not_replaced(tmp_path):
    image = tmp_path / "rgb_C1_0001.jpg"
    image.touch()
    with pytest.raises(ConfigError, match=r"is a part of the input"):
        refuse_input(image, [tmp_path])
    refuse_input(tmp_path / "rgb_C1_0002.jpg", [tmp_path])  # not there: nothing is lost


@pytest.mark.parametrize("where", ["in", ".", "linked", "in/out"])
def test_a_folder_that_is_in_or_holds_an_input_is_refused(run, tiny, tmp_path, where):
    """A recording, the folder around it, one that links of the recording lead into, or one inside it."""
    write(tmp_path / "linked", a="1")
    recording = tmp_path / "in"
    with whole_folder(recording) as made:
        shutil.copytree(tiny.recording, made, dirs_exist_ok=True)
    shutil.move(recording / "C2", tmp_path / "linked" / "C2")
    (recording / "C2").symlink_to(tmp_path / "linked" / "C2")
    before = tree(tmp_path)
    outcome = run("correct", recording, "--rig", tiny.rig_path, "--overwrite", "-o", tmp_path / where)
    assert outcome.status == 2 and "input" in outcome.stderr
    assert tree(tmp_path) == before


def test_import_does_not_replace_what_it_reads(run, tmp_path):
    (tmp_path / "tum").mkdir()
    (tmp_path / "tum" / "rgb.txt").write_text("1.0 rgb/0.png\n")
    for output in (tmp_path / "tum", tmp_path, tmp_path / "tum" / "out" / "new"):
        outcome = run("import", tmp_path / "tum", "-o", output, "--overwrite")
        assert outcome.status == 2 and "input" in outcome.stderr
    assert tree(tmp_path) == ["tum", "tum/rgb.txt"]


def test_two_outputs_of_one_name(run, tiny, tmp_path):
    outcome = run("calibrate", tiny.recording, "-o", tmp_path / "a.yaml", "--correspondences", tmp_path / "A.yaml")
    assert outcome.status == 2 and "is also the output" in outcome.stderr and tree(tmp_path) == []

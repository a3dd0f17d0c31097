"""A full disk, a folder that cannot be written, things in the way: one line, status 2, the old file, no leftover."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io import files, folders, temporary
from rgbd_calib.io.drawings import Fill, Sheet, write_pdf, write_svg
from rgbd_calib.io.files import whole_file, whole_folder, write_text
from rgbd_calib.io.folders import MARKER
from rgbd_calib.io.growing_recording import CameraImages, GrowingRecording
from rgbd_calib.io.images import write_image
from rgbd_calib.io.pictures import write_picture
from rgbd_calib.io.residuals import Residuals, read_residuals_of, residuals_path, write_result
from rgbd_calib.io.rig import read_rig, write_rig
from rgbd_calib.io.tables import write_table
from rgbd_calib.pipeline.fuse import write_ply
from rgbd_calib.types import Rig, RigCamera

resource = pytest.importorskip("resource", reason="limits of a file's size are POSIX")
NOISE = np.random.default_rng(0).integers(0, 256, (200, 200, 3), np.uint8)
SHEET = Sheet(2000, 2000, tuple(Fill(((i, 7.0 * i % 101, 1.5, 2.5),)) for i in range(2000)))
LIMIT = 8192
WRITERS: dict[str, Callable[[Path], object]] = {
    "text.yaml": lambda path: write_text(path, "x" * 100_000),
    "table.csv": lambda path: write_table(path, ("a",), [["x" * 100_000]]),
    "image.png": lambda path: write_image(path, NOISE),
    "picture.png": lambda path: write_picture(path, NOISE),
    "cloud.ply": lambda path: write_ply(path, np.zeros((9000, 3)), np.zeros((9000, 3), np.uint8)),
    "sheet.pdf": lambda path: write_pdf(path, (SHEET,) * 8, "a"),
    "sheet.svg": lambda path: write_svg(path, SHEET, "a"),
}


@contextmanager
def small_files() -> Iterator[None]:
    """No file of this process grows beyond LIMIT, as where a disk is full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_leaves_the_old_file(tmp_path, name):
    path = tmp_path / name
    path.write_text("old")
    with small_files(), pytest.raises(ConfigError, match=f"{name}: c.*be written"):
        WRITERS[name](path)
    assert path.read_text() == "old" and names(tmp_path) == [name]
    WRITERS[name](path)
    assert path.stat().st_size > LIMIT and names(tmp_path) == [name]


@pytest.fixture
def full_disk(tmp_path) -> Iterator[Path]:
    """A disk of 32 kB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=32k", "tmpfs", str(disk)]
    if (
        sys.platform != "linux"
        or os.geteuid() != 0
        or subprocess.run(mount, capture_output=True, check=False).returncode
    ):
        pytest.skip("only root may mount a small disk")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.parametrize("name", WRITERS)
def test_no_space_left_on_the_device(full_disk, name):
    (full_disk / name).write_text("old")
    with pytest.raises(ConfigError, match=rf"{name}: c.*be written.*(No space left|disk full)"):
        WRITERS[name](full_disk / name)
    assert (full_disk / name).read_text() == "old" and names(full_disk) == [name]


def test_a_folder_that_does_not_fit_leaves_the_old_one(tmp_path):
    folder_of_ours(tmp_path / "out", a="old")
    new = whole_folder(tmp_path / "out", overwrite=True)
    with small_files(), pytest.raises(ConfigError, match="out: cannot be written"), new as folder:
        (folder / "a").write_text("x" * 100_000)
    assert (tmp_path / "out" / "a").read_text() == "old" and names(tmp_path) == ["out"]


def test_a_capture_on_a_full_disk_keeps_its_frames(tmp_path):
    recording = GrowingRecording(tmp_path / "rec")
    small = np.zeros((6, 8, 3), np.uint8)
    recording.add(recording.reserve(), {"C1": CameraImages(small, None)})
    with small_files(), pytest.raises(Exception, match="1 frame set of this session kept"):
        recording.add(recording.reserve(), {"C1": CameraImages(NOISE, None)})
    assert names(tmp_path / "rec" / "C1" / "color") == ["000000.png"]


@pytest.mark.parametrize("code", [errno.EROFS, errno.EACCES, errno.ENOSPC, errno.EDQUOT])
def test_what_the_system_refuses_is_said(tmp_path, monkeypatch, code):
    def refuse(path, *_):
        raise OSError(code, os.strerror(code), str(path))

    monkeypatch.setattr(temporary.os, "open", refuse)
    with pytest.raises(ConfigError, match=f"a.yaml: cannot be written \\({os.strerror(code)}"):
        write_text(tmp_path / "a.yaml", "a")
    monkeypatch.undo()
    assert names(tmp_path) == []


def test_an_error_of_a_file_that_is_read_meanwhile_is_not_blamed_on_the_written_one(tmp_path):
    with pytest.raises(FileNotFoundError), whole_file(tmp_path / "a"):
        (tmp_path / "source").read_text()


@pytest.mark.parametrize("args", [("board", "--square", "0.06"), ("simulate",)])
def test_what_cannot_be_written_is_said_before_any_work(run, tmp_path, args):
    (tmp_path / "file").write_text("")
    target = tmp_path / "file" / "deep" / "out.pdf"
    outcome = run(args[0], target) if args[0] == "simulate" else run(*args, "-o", target)
    assert outcome.status == 2 and "file" in outcome.stderr and names(tmp_path) == ["file"]


def test_things_in_the_way(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "precious").touch()
    with pytest.raises(ConfigError, match=r"folder: cannot be written.*in the way"):
        write_text(tmp_path / "folder", "a")
    (tmp_path / "file").write_text("precious")
    with (
        pytest.raises(ConfigError, match=r"file: cannot be written.*in the way"),
        whole_folder(tmp_path / "file") as made,
    ):
        (made / "a").touch()
    assert names(tmp_path) == ["file", "folder"] and (tmp_path / "file").read_text() == "precious"


def folder_of_ours(path: Path, **content: str) -> Path:
    with whole_folder(path) as made:
        for name, text in content.items():
            (made / name).write_text(text)
    return path


def test_a_folder_replaces_no_file_and_is_written_through_a_link(tmp_path):
    folder_of_ours(tmp_path / "elsewhere", a="old")
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "file").touch()
    with whole_folder(tmp_path / "link", overwrite=True) as made:
        (made / "b").touch()
    with (
        pytest.raises(ConfigError, match="file: a folder was expected"),
        whole_folder(tmp_path / "file", overwrite=True),
    ):
        pass
    assert names(tmp_path / "elsewhere") == [MARKER, "b"] and names(tmp_path) == ["elsewhere", "file", "link"]
    assert (tmp_path / "link").is_symlink()


def test_a_kill_between_the_two_renames_of_a_folder_is_mended_by_the_next_run(tmp_path):
    folder_of_ours(tmp_path / "out", a="old").rename(tmp_path / ".out.replaced")
    with pytest.raises(RuntimeError), whole_folder(tmp_path / "out", overwrite=True):
        raise RuntimeError
    assert (tmp_path / "out" / "a").read_text() == "old" and names(tmp_path) == ["out"]


def test_the_old_folder_comes_back_where_the_new_one_cannot_be_put(tmp_path, monkeypatch):
    folder_of_ours(tmp_path / "out", a="old")
    real = Path.replace

    def fail(self, target):
        if temporary.MARK in self.name:
            raise OSError(errno.EIO, "broken disk", str(self))
        return real(self, target)

    monkeypatch.setattr(folders, "_exchange", lambda a, b: False)  # as on systems that have none
    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(ConfigError, match="broken disk"), whole_folder(tmp_path / "out", overwrite=True) as made:
        (made / "a").write_text("new")
    assert (tmp_path / "out" / "a").read_text() == "old" and names(tmp_path) == ["out"]


def test_leftovers_of_killed_runs_are_removed_and_those_of_living_ones_are_not(tmp_path):
    (tmp_path / ".rig.partial-0123abcd.yaml").write_text("half")
    (tmp_path / ".rig.backup.yaml").write_text("somebody's")
    (tmp_path / ".out.partial-0123abcd").mkdir()
    with whole_file(tmp_path / "rig.yaml") as living:
        living.write_text("a")
        write_text(tmp_path / "rig.yaml", "b")
        assert living.exists()
    with whole_folder(tmp_path / "out"):
        pass
    assert names(tmp_path) == [".rig.backup.yaml", "out", "rig.yaml"] and (tmp_path / "rig.yaml").read_text() == "a"


def test_a_file_is_on_the_disk_before_its_name(tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr(files, "flush", lambda path: done.append(("data", path.read_text())))
    monkeypatch.setattr(files, "flush_name", lambda path: done.append(("name", path.read_text())))
    write_text(tmp_path / "a", "text")
    assert done == [("data", "text"), ("name", "text")]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_takes_away_what_was_being_written(tmp_path, number):
    """A child stands still in the middle of a write; what it says and leaves."""
    code = (
        "import signal, sys, time, pathlib, rgbd_calib.cli.main as m\n"
        "from rgbd_calib.io.files import whole_file\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # the tests may run where nohup or & has it ignored
        "signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"
        "def slow(**_):\n"
        "    with whole_file(pathlib.Path(sys.argv[2])) as t:\n"
        "        t.write_text('half'); time.sleep(60)\n"
        "m.cli.main = slow\nm.main()"
    )
    child = subprocess.Popen([sys.executable, "-c", code, "x", str(tmp_path / "rig.yaml")], stderr=subprocess.PIPE)
    end = time.monotonic() + 30
    while not names(tmp_path) and time.monotonic() < end:
        time.sleep(0.01)
    time.sleep(0.05)
    child.send_signal(number)
    said = child.communicate(timeout=30)[1].decode()
    if number == signal.SIGINT:  # click makes Abort of it, which `slow` is not part of
        assert child.returncode != 0
    else:
        assert child.returncode == 128 + number and "nothing was left half-written" in said
    assert names(tmp_path) == []


def test_a_rig_and_its_residuals_belong_together(tmp_path):
    lens = Intrinsics(8, 6, 9.0, 9.0, 3.5, 2.5)
    a_rig = Rig("C1", {"C1": RigCamera(lens, np.eye(4), np.zeros((6, 6)))})
    rows = [np.array(["C1"]), np.array(["0"]), np.array(["0"]), *(np.ones((1, 2)),) * 2, *(np.ones(1),) * 2]
    residuals = Residuals(*rows, np.ones(1, bool), np.ones(1, bool))
    path = tmp_path / "rig.yaml"
    write_result(path, a_rig, {}, residuals)
    rig = read_rig(path)
    assert len(rig.quality.residuals_sha256) == 64
    found = read_residuals_of(path, rig)
    assert found is not None and found.camera.tolist() == ["C1"]
    text = residuals_path(path).read_text()
    residuals_path(path).write_text(text.replace("C1", "C2"))
    with pytest.raises(ConfigError, match=r"rig.residuals.csv: SHA-256 .* different calibrations"):
        read_residuals_of(path, rig)
    write_rig(path, a_rig)  # of a release that did not know of the hash
    assert read_residuals_of(path, read_rig(path)) is not None
    residuals_path(path).unlink()
    assert read_residuals_of(path, rig) is None


def test_a_view_that_does_not_fit(run, tiny, full_disk):
    pytest.importorskip("rerun", reason="the extra `view` is not installed")
    out = run("view", tiny.rig_path, tiny.recording, "--save", full_disk / "a.rrd")
    assert out.status == 2 and "a.rrd: c" in out.stderr and names(full_disk) == []

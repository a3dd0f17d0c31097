"""Detections kept by content: never stale, never in the way, the same bits as a new detection."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_recording import draw_recording

from rgbd_calib.io.cache import BLOCK_BYTES, FileCache, default_folder
from rgbd_calib.io.recording import open_recording, save_color, save_depth
from rgbd_calib.pipeline import detection, detection_cache
from rgbd_calib.pipeline.detection import detect
from rgbd_calib.pipeline.detection_cache import contents, entry, key_of, read_entry
from rgbd_calib.pipeline.workers import Workers
from rgbd_calib.types import Board, BoardView
from rgbd_calib.views.detect import DetectParams

AT = ("C1", "000000")


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Two cameras, three frames; the board is hidden in one image, and one has no depth."""
    folder = draw_recording(tmp_path_factory.mktemp("cached") / "recording", 2, 3)
    save_color(folder, "C2", "000002", np.full((480, 640, 3), 90, np.uint8))
    (folder / "C2" / "depth" / "000001.png").unlink()
    return folder


@pytest.fixture(autouse=True)
def young_files(monkeypatch):
    """However long a test takes, its files are too young for their times to count."""
    monkeypatch.setattr(detection_cache, "SETTLED_NS", 10**18)


@pytest.fixture
def old_files(monkeypatch, young_files):
    monkeypatch.setattr(detection_cache, "SETTLED_NS", -(10**18))


@pytest.fixture
def recording(drawn, tmp_path):
    shutil.copytree(drawn, tmp_path / "recording")
    return open_recording(tmp_path / "recording")


def found(recording, folder, params=None):
    """Views, and what was said."""
    said = []
    views = detect(recording, params or DetectParams(), Workers(1, cache=folder, say=said.append)).views
    return views, said


def bits(views):
    return [
        (v.camera, v.frame, [(getattr(v, f.name).dtype, getattr(v, f.name).tobytes()) for f in fields(v)[2:6]])
        for v in views
    ]


def entries(folder):
    return sorted(path for path in folder.rglob("*") if path.is_file())


def test_what_is_read_back_is_what_was_found_bit_for_bit(recording, tmp_path, monkeypatch):
    first, said = found(recording, tmp_path / "cache")
    assert said == [] and len(first) == 5 and any(np.isnan(v.depth_m).all() for v in first)
    monkeypatch.setattr(detection, "find_corners", None)  # nothing is detected any more
    again, said = found(recording, tmp_path / "cache")
    assert bits(again) == bits(first)
    assert said == [f"{recording.path}: 6 of 6 images from the cache"]
    assert len(entries(tmp_path / "cache")) == 6


def test_an_entry_holds_any_view():
    view = BoardView(
        *AT, np.array([3, 1]), np.array([[0.1, -0.0], [1e300, 5e-324]]), np.array([np.nan, 1]), np.zeros(2, int)
    )
    assert bits(read_entry(entry(view), *AT)) == bits([view])
    empty = BoardView(*AT, np.zeros(0, int), np.zeros((0, 2)), np.zeros(0), np.zeros(0, int))
    assert bits(read_entry(entry(empty), *AT)) == bits([empty])
    assert read_entry(entry(None), *AT) == (None,)
    assert read_entry(b"something else", *AT) is None
    pickled = np.lib.format.header_data_from_array_1_0(np.zeros(1, object))
    assert "O" in pickled["descr"]  # such a header would ask for a pickle: numpy refuses it
    import io

    stream = io.BytesIO()
    np.save(stream, np.array([{}], object), allow_pickle=True)
    assert read_entry(stream.getvalue(), *AT) is None


def test_the_key_has_all_that_the_result_depends_on(recording, monkeypatch):
    camera, frame = AT
    board = Board(9, 6, 0.06)

    usual = DetectParams()

    def key(recording=recording, board=board, params=usual):
        return key_of(contents(recording, *AT), recording, camera, board, params)

    keys = {key()}
    assert key() in keys and key(open_recording(recording.path)) in keys
    info = recording.cameras[camera]
    for changed in (replace(info, depth_scale=0.0005), replace(info, width=641), replace(info, height=481)):
        keys.add(key(replace(recording, cameras={camera: changed})))
    others = {"cols": 8, "rows": 7, "square_m": 0.05, "two_sided": True, "thickness_m": 0.006, "type": "charuco"}
    others |= {"marker_m": 0.04, "dictionary": "DICT_5X5_250", "legacy": True}
    assert set(others) | {"shape"} == {f.name for f in fields(Board)}  # how corners are numbered, not where they stand
    for name, value in others.items():
        keys.add(key(board=replace(board, **{name: value})))
    settings = {"escalate": False, "min_corners": 7, "min_share": 0.7}
    assert set(settings) == {f.name for f in fields(DetectParams)}
    for name, value in settings.items():
        keys.add(key(params=replace(usual, **{name: value})))
    monkeypatch.setattr(detection_cache, "detector", lambda: "another")
    keys.add(key())
    monkeypatch.undo()
    depth = recording.depth_files[camera][frame]
    raw = depth.read_bytes()
    depth.write_bytes(raw[:-1])
    keys.add(key())
    depth.unlink()
    keys.add(key(open_recording(recording.path)))
    depth.write_bytes(raw)
    color = recording.color_files[camera][frame]
    color.write_bytes(color.read_bytes() + b"\0")
    keys.add(key())
    assert len(keys) == 1 + 3 + len(others) + len(settings) + 1 + 3


def test_the_detector_is_its_sources_and_its_libraries(monkeypatch):
    before = detection_cache.detector()
    for library in (cv2, np):
        monkeypatch.setattr(library, "__version__", "0.0.0")
        assert detection_cache.detector.__wrapped__() != before
        monkeypatch.undo()
    real = Path.read_bytes
    for source in ("subpixel.py", "resection.py", "types.py", "recording.py"):
        monkeypatch.setattr(Path, "read_bytes", lambda p, s=source: real(p) + b"#" * (p.name == s))
        assert detection_cache.detector.__wrapped__() != before
        monkeypatch.undo()
    assert detection_cache.detector.__wrapped__() == before


def test_a_changed_image_is_looked_at_again_at_once(recording, tmp_path):
    found(recording, tmp_path / "cache")
    files = recording.color_files["C1"]
    at = os.stat(files["000000"])
    shutil.copyfile(files["000001"], files["000000"])
    os.utime(files["000000"], ns=(at.st_atime_ns, at.st_mtime_ns))  # the time of a file says nothing
    save_depth(recording.path, "C2", "000000", np.full((480, 640), 1234, np.uint16))
    views, said = found(recording, tmp_path / "cache")
    assert said == [f"{recording.path}: 4 of 6 images from the cache"]
    assert bits(views) == bits(found(recording, None)[0])


def test_a_second_run_reads_no_image(recording, tmp_path, monkeypatch, old_files):
    first, _ = found(recording, tmp_path / "cache")
    assert len(entries(tmp_path / "cache")) == 6 + 2  # and the hashes of each camera
    monkeypatch.setattr(detection_cache, "_sha256", lambda path: pytest.fail(f"{path} was read"))
    again, said = found(recording, tmp_path / "cache")
    assert bits(again) == bits(first) and said == [f"{recording.path}: 6 of 6 images from the cache"]


@pytest.mark.skipif(sys.platform == "win32", reason="has no time of change that cannot be set")
def test_a_file_of_the_same_size_and_time_is_noticed(recording, tmp_path, old_files):
    first, second = (recording.color_files["C1"][frame] for frame in ("000000", "000001"))
    for path in (first, second):
        path.write_bytes(path.read_bytes().ljust(2**20, b"\0"))  # after a PNG's end anything may follow
    found(recording, tmp_path / "cache")
    at = os.stat(first)
    first.write_bytes(second.read_bytes())
    os.utime(first, ns=(at.st_atime_ns, at.st_mtime_ns))
    assert (os.stat(first).st_size, os.stat(first).st_mtime_ns) == (at.st_size, at.st_mtime_ns)
    assert bits(found(recording, tmp_path / "cache")[0]) == bits(found(recording, None)[0])


def test_young_files_are_hashed_again(recording, tmp_path):
    found(recording, tmp_path / "cache")
    assert len(entries(tmp_path / "cache")) == 6


def test_damaged_hashes_are_taken_anew(recording, tmp_path, old_files):
    good, _ = found(recording, tmp_path / "cache")
    for damage in (b"", b"[1]", b"no JSON"):
        for path in entries(tmp_path / "cache"):
            path.write_bytes(damage)
        assert bits(found(recording, tmp_path / "cache")[0]) == bits(good)


def test_an_image_that_changes_under_the_detector_is_not_kept(recording, tmp_path, monkeypatch):
    real, path = detection.find_corners, recording.color_files["C1"]["000000"]
    replaced = recording.color_files["C1"]["000001"].read_bytes()

    def slow(*image_and_board):
        path.write_bytes(replaced)  # the first image, while it is searched
        return real(*image_and_board)

    monkeypatch.setattr(detection, "find_corners", slow)
    found(recording, tmp_path / "cache")
    monkeypatch.undo()
    assert len(entries(tmp_path / "cache")) == 5
    assert bits(found(recording, tmp_path / "cache")[0]) == bits(found(recording, None)[0])


def test_errors_are_not_kept_and_sizes_are_checked_on_every_run(recording, run, tmp_path, monkeypatch):
    monkeypatch.setenv("RGBD_CALIB_CACHE", str(tmp_path / "cache"))
    assert run("detect", recording.path, "-o", tmp_path / "a.csv", "--jobs", 1).status == 0
    text = (recording.path / "dataset.yaml").read_text()
    (recording.path / "dataset.yaml").write_text(text.replace("height: 480", "height: 481"))
    for _ in range(2):
        outcome = run("detect", recording.path, "-o", tmp_path / "b.csv", "--jobs", 1)
        assert outcome.status == 2 and "640x480 px seen" in outcome.stderr


@pytest.mark.parametrize("damage", ["truncated", "changed", "empty", "other", "folder", "huge"])
def test_a_damaged_entry_is_found_anew_and_mended(recording, tmp_path, damage):
    folder = tmp_path / "cache"
    good, _ = found(recording, folder)
    paths = entries(folder)
    whole = [path.read_bytes() for path in paths]
    for k, path in enumerate(paths):
        raw = bytearray(whole[k])
        if damage == "truncated":
            path.write_bytes(raw[: len(raw) // 2])
        elif damage == "changed":
            raw[-1] ^= 1
            path.write_bytes(raw)
        elif damage == "other":
            path.write_bytes(whole[k - 1])  # a good entry in the wrong place
        elif damage == "folder":
            path.unlink()
            path.mkdir()
        else:
            path.write_bytes(b"" if damage == "empty" else bytes(raw) + bytes(2**21))
    views, said = found(recording, folder)
    assert bits(views) == bits(good)
    if damage == "folder":
        assert len(said) == 1 and "going on without" in said[0]
    else:
        assert said == []
        assert [path.read_bytes() for path in paths] == whole


def test_a_folder_that_cannot_be_used_is_said_once(recording, tmp_path):
    good, _ = found(recording, None)
    (tmp_path / "file").write_text("no folder")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        views, said = found(recording, folder)
        assert bits(views) == bits(good)
        assert len(said) == 1 and str(folder) in said[0] and "RGBD_CALIB_CACHE" in said[0]


def test_a_full_disk_is_said_once(recording, tmp_path, monkeypatch):
    def full(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("rgbd_calib.io.cache.os.replace", full)
    views, said = found(recording, tmp_path / "cache")
    assert bits(views) == bits(found(recording, None)[0])
    assert len(said) == 1 and "No space left" in said[0]
    assert entries(tmp_path / "cache") == []  # no temporary file either


def test_it_may_be_deleted_while_it_is_used(recording, tmp_path):
    folder, stop = tmp_path / "cache", threading.Event()

    def delete():
        while not stop.is_set():
            shutil.rmtree(folder, ignore_errors=True)

    thread = threading.Thread(target=delete)
    thread.start()
    try:
        for _ in range(3):
            views, _ = found(recording, folder)
            assert len(views) == 5
    finally:
        stop.set()
        thread.join()


def test_it_stays_below_its_bound_and_drops_what_was_used_longest_ago(tmp_path):
    said = []
    files = FileCache(tmp_path, said.append, limit_bytes=20 * BLOCK_BYTES)
    keys = [f"{i:064x}"[::-1] for i in range(1, 31)]
    for i, key in enumerate(keys):
        files.put(key, b"x" * i)
        os.utime(tmp_path / key[:2] / key, (1e9 + i, 1e9 + i))
    assert files.get(keys[0]) == b""  # used just now
    old = tmp_path / keys[0][:2] / ".partial-leftover"
    old.write_bytes(b"of a killed process")
    os.utime(old, (1e9, 1e9))
    files.close()
    assert files.usage() == (18, 18 * BLOCK_BYTES)  # a tenth below the limit
    assert [key for key in keys if files.get(key) is not None] == [keys[0], *keys[-17:]]
    assert not old.exists() and said == []


def test_two_processes_at_once(drawn, tmp_path):
    """Both find the same, whoever stored what."""
    command = [sys.executable, "-m", "rgbd_calib", "detect", str(drawn), "--jobs", "1", "-o"]
    environment = os.environ | {"RGBD_CALIB_CACHE": str(tmp_path / "cache")}
    both = [subprocess.Popen([*command, str(tmp_path / name)], env=environment) for name in ("a.csv", "b.csv")]
    assert [process.wait(120) for process in both] == [0, 0]
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    assert len(entries(tmp_path / "cache")) in (
        6,
        6 + 2,
    )  # with the hashes of each camera where the files are old enough
    assert len(found(open_recording(drawn), tmp_path / "cache")[1]) == 1


def test_the_place(monkeypatch, tmp_path):
    monkeypatch.setenv("RGBD_CALIB_CACHE", str(tmp_path / "own"))
    assert default_folder() == tmp_path / "own"
    monkeypatch.delenv("RGBD_CALIB_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    if sys.platform == "linux":
        assert default_folder() == tmp_path / "xdg" / "rgbd-calib"


def test_commands_share_it_and_can_go_without(recording, run, tmp_path, monkeypatch):
    monkeypatch.setenv("RGBD_CALIB_CACHE", str(tmp_path / "cache"))
    assert run("detect", recording.path, "-o", tmp_path / "a.csv", "--no-cache", "--jobs", 1).status == 0
    assert not (tmp_path / "cache").exists()
    assert "from the cache" not in run("detect", recording.path, "-o", tmp_path / "b.csv", "--jobs", 1).stderr
    assert "6 of 6 images from the cache" in run("doctor", recording.path, "--jobs", 1).stderr
    outcome = run("detect", recording.path, "-o", tmp_path / "c.csv", "--jobs", 1)
    assert "6 of 6 images from the cache" in outcome.stderr and outcome.stdout == ""
    assert len({(tmp_path / name).read_bytes() for name in ("a.csv", "b.csv", "c.csv")}) == 1
    assert run("cache").stdout.startswith(f"{tmp_path / 'cache'}: 6 entries, 0.0 of 256 MiB")
    assert "0 entries" in run("cache", "--clear").stdout
    assert entries(tmp_path / "cache") == []


def test_doctor_fills_it_too_and_says_the_same(recording, run, tmp_path, monkeypatch):
    monkeypatch.setenv("RGBD_CALIB_CACHE", str(tmp_path / "cache"))
    first = run("doctor", recording.path, "--jobs", 1)
    again = run("doctor", recording.path, "--jobs", 1)
    assert "6 of 6 images from the cache" in again.stderr
    assert (again.stdout, again.status) == (first.stdout, first.status)

"""Only regular files are read, and only up to a limit: pipes, devices, growing files and compressed bombs end at once."""

from __future__ import annotations

import bz2
import os
import shutil
import socket
from pathlib import Path

import pytest
from test_import import write_bag

from rgbd_calib.errors import ConfigError
from rgbd_calib.io import bag_limits, tables
from rgbd_calib.io.foreign.ros import RosBag
from rgbd_calib.io.reading import open_regular, read_bytes, read_chunks
from rgbd_calib.pipeline import detection_cache

pytestmark = [
    pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes"),
    pytest.mark.timeout(60),  # a pipe that is opened waits for ever
]


def test_a_regular_file_is_read_up_to_the_limit(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a", 5) == b"12345"
    with pytest.raises(ConfigError, match="larger than"):
        read_bytes(tmp_path / "a", 4)
    with pytest.raises(ConfigError, match="no such file"):
        read_bytes(tmp_path / "b", 4)


def test_what_is_no_regular_file_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    Path("folder").mkdir()
    Path("device").symlink_to("/dev/zero")
    with socket.socket(socket.AF_UNIX) as made:
        made.bind("socket")
    for name, kind in (("pipe", "pipe"), ("folder", "folder"), ("device", "device"), ("socket", "socket")):
        with pytest.raises(ConfigError, match=f"{name}: a regular file was expected, a (named )?{kind} was found"):
            read_bytes(Path(name), 100)


def test_a_file_that_grows_while_it_is_read_has_an_end(tmp_path):
    (tmp_path / "a").write_bytes(b"x")
    with pytest.raises(ConfigError, match="larger than"), (tmp_path / "a").open("ab", buffering=0) as writer:
        for _ in read_chunks(tmp_path / "a", 10_000):
            writer.write(b"x" * 1000)


def test_a_pipe_put_in_the_place_of_a_file_is_not_read(tmp_path, monkeypatch):
    """Between the first look at the file and its opening."""
    (tmp_path / "a").write_bytes(b"x")
    os.mkfifo(tmp_path / "pipe")
    real = os.open
    monkeypatch.setattr("rgbd_calib.io.reading.os.open", lambda path, flags: real(tmp_path / "pipe", flags))
    with pytest.raises(ConfigError, match="named pipe"), open_regular(tmp_path / "a", 10):
        pass


@pytest.mark.parametrize("name", ["f.bag", "f.mcap", "f.db3", "f.oni"])
def test_import_of_a_pipe(run, tmp_path, name):
    os.mkfifo(tmp_path / name)
    outcome = run("import", tmp_path / name, "-o", tmp_path / "out")
    assert outcome.status == 2 and "a named pipe was found" in outcome.stderr


def test_pipes_as_files_of_settings_and_tables(run, tiny, tmp_path):
    for name in ("f.yaml", "f.csv"):
        os.mkfifo(tmp_path / name)
    pipe, table, out = tmp_path / "f.yaml", tmp_path / "f.csv", tmp_path / "out.yaml"
    for args in (
        ("calibrate", tiny.recording, "--corners", table, "-o", out),
        ("calibrate", tiny.recording, "--config", pipe, "-o", out),
        ("calibrate", tiny.recording, "--intrinsics", pipe, "-o", out),
        ("refine", table, "--intrinsics", tiny.rig_path, "-o", out),
        ("evaluate", pipe, "--truth", "/dev/zero"),
        ("calibrate", tiny.recording, "--update", pipe, "--only", "C1", "-o", out),
    ):
        outcome = run(*args)
        assert outcome.status == 2 and "a regular file was expected" in outcome.stderr, args


@pytest.mark.parametrize("kind", ["pipe", "endless"])
def test_images_that_never_end(run, tiny, tmp_path, kind):
    shutil.copytree(tiny.recording, tmp_path / "in")
    image = tmp_path / "in" / "C1" / "color" / "000000.png"
    image.unlink()
    os.mkfifo(image) if kind == "pipe" else image.symlink_to("/dev/zero")
    for args in (
        ("detect", tmp_path / "in", "-o", tmp_path / "corners.csv"),
        ("correct", tmp_path / "in", "--rig", tiny.rig_path, "-o", tmp_path / "out"),
        ("fuse", tmp_path / "in", "--rig", tiny.rig_path, "--frame", "000000", "-o", tmp_path / "a.ply"),
    ):
        outcome = run(*args)
        assert outcome.status == 2 and "C1/color/000000.png: a regular file was expected" in outcome.stderr, args
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in"]


def test_the_detection_cache_opens_no_pipe(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ConfigError, match="named pipe"):
        detection_cache._sha256(tmp_path / "pipe")


def test_a_table_has_an_end(tmp_path, monkeypatch):
    path = tmp_path / "a.csv"
    path.write_text("a\n" + "1\n" * 100)
    assert len(list(tables.read_table(path, ("a",)))) == 100
    with pytest.raises(ConfigError, match="grows while it is read"), path.open("a", buffering=1) as writer:
        for _ in tables.read_table(path, ("a",)):
            writer.write("1\n" * 100)
    path.write_text("a" * 100)
    monkeypatch.setattr(tables, "MAX_LINE", 50)
    with pytest.raises(ConfigError, match="a line of"):
        list(tables.read_table(path, ("a",)))


def bomb_bz2(size: int) -> bytes:
    return bz2.compress(bytes(size))


def bomb_zstd(size: int) -> bytes:
    return bag_limits.zstd.compress(bytes(size))


def bomb_lz4(size: int) -> bytes:
    return pytest.importorskip("lz4.frame").compress(bytes(size))


@pytest.mark.parametrize(
    ("make", "expand"),
    [(bomb_bz2, bag_limits._bz2), (bomb_zstd, bag_limits._zstd), (bomb_lz4, bag_limits._lz4)],
)
def test_compressed_data_expand_up_to_the_limit(monkeypatch, make, expand):
    monkeypatch.setattr(bag_limits, "MAX_CHUNK_BYTES", 1 << 20)
    assert expand(make(1 << 20)) == bytes(1 << 20)
    with pytest.raises(ValueError, match="expand to more than 1 MB"):
        expand(make((1 << 20) + 1))
    with pytest.raises(ValueError, match="end early"):
        expand(make(1000)[:-5])
    with pytest.raises(ValueError, match=r"damaged|end early"):
        expand(b"none of the kind")


@pytest.mark.parametrize("compression", ["BZ2", "LZ4"])
def test_a_compressed_bag_is_read_and_one_that_expands_beyond_the_limit_is_not(tmp_path, monkeypatch, compression):
    from rosbags.rosbag1 import Writer

    real = Writer.open
    monkeypatch.setattr(
        Writer, "open", lambda self: (self.set_compression(Writer.CompressionFormat[compression]), real(self))
    )
    path = write_bag(tmp_path / "rig.bag", "ros1")
    pictures = list(RosBag(path).pictures(lambda *picture: True))
    assert pictures
    monkeypatch.setattr(bag_limits, "MAX_CHUNK_BYTES", 1000)
    with pytest.raises(ConfigError, match=r"rig\.bag: cannot be read as a ROS bag \(compressed data expand"):
        list(RosBag(path).pictures(lambda *picture: True))


@pytest.mark.parametrize("mode", ["FILE", "MESSAGE", "STORAGE"])
def test_a_compressed_bag_of_ros_2(tmp_path, monkeypatch, mode):
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, Writer

    real = Writer.open

    def compressed(self):
        self.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
        return real(self)

    monkeypatch.setattr(Writer, "open", compressed)
    path = write_bag(tmp_path / "rig", "mcap" if mode == "STORAGE" else "ros2")
    assert list(RosBag(path).pictures(lambda *picture: True))
    monkeypatch.setattr(bag_limits, "MAX_CHUNK_BYTES", 10)
    monkeypatch.setattr(bag_limits, "MAX_RATIO", 0.1)
    with pytest.raises(ConfigError, match=r"rig: cannot be read as a ROS bag \(.*expand to more than"):
        list(RosBag(path).pictures(lambda *picture: True))

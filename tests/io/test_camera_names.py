"""Names of cameras and frames as people have them: kept through files, exports and back, or refused with a reason."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbd_calib.io.calibrations import read_calibration
from rgbd_calib.io.layout import FilePatterns
from rgbd_calib.io.recording import open_recording, save_color, save_depth, write_dataset
from rgbd_calib.io.rig import read_rig, write_rig
from rgbd_calib.io.schema_base import check_name
from rgbd_calib.types import Board

NAMES = {
    "marks": ("#1", "a #b", "[c]"),
    "braces": ("{camera}", "}x{", "{frame}"),
    "spaces and percent": ("left  cam", "50%", "%(a)s"),
    "unicode": ("ünï", "目", "ß"),
    "dashes": ("-c", "--help", "-"),
    "numbers": ("1", "0x10", "1e5"),
    "words of YAML": ("on", "null", "True"),
    "quotes": ("it's", 'a"b', "$HOME"),
    "HTML": ("<b>", "&amp;", "~"),
}


@pytest.fixture(params=NAMES.values(), ids=NAMES)
def named(request, tiny, tmp_path):
    """The tiny recording and its rig, with these names in place of C1, C2, C3."""
    new = dict(zip(tiny.rig.cameras, request.param, strict=True))
    recording = tmp_path / "recording"
    for old, name in new.items():
        shutil.copytree(tiny.recording / old, recording / name)
    infos = open_recording(tiny.recording).cameras
    write_dataset(recording, {name: infos[old] for old, name in new.items()}, Board(9, 6, 0.06))
    lenses = [
        replace(own.intrinsics, fx=60.0 + i) for i, own in enumerate(tiny.rig.cameras.values())
    ]  # else one, carried
    cameras = {
        new[old]: replace(own, intrinsics=K) for (old, own), K in zip(tiny.rig.cameras.items(), lenses, strict=True)
    }
    write_rig(tmp_path / "rig.yaml", replace(tiny.rig, reference=new["C1"], cameras=cameras))
    return recording, tmp_path / "rig.yaml", list(new.values())


def test_commands_keep_names(run, named, tmp_path):
    recording, rig, names = named
    assert sorted(read_rig(rig).cameras) == sorted(names)
    for args in (
        ("correct", recording, "--rig", rig, "-o", tmp_path / "corrected"),
        ("fuse", recording, "--rig", rig, "-o", tmp_path / "cloud.ply"),
        ("import", recording, "-o", tmp_path / "imported"),
        ("report", rig, "-o", tmp_path / "report"),
        ("view", rig, recording, "--save", tmp_path / "view.rrd"),
    ):
        told = run(*args)
        assert told.status == 0, told.stderr
    assert sorted(open_recording(tmp_path / "corrected").cameras) == sorted(names)
    assert sorted(open_recording(tmp_path / "imported").cameras) == sorted(names)


@pytest.mark.parametrize(
    ("to", "file"),
    [
        ("kalibr", "chain.yaml"),
        ("colmap", "model"),
        ("nerfstudio", "transforms.json"),
        ("opencv", "rig.yml"),
        ("opencv", "rig.xml"),
        ("opencv", "rig.json"),
        ("json", "rig.json"),
    ],
)
def test_exports_give_the_names_back(run, named, tmp_path, to, file):
    _, rig, names = named
    told = run("export", rig, "--to", to, tmp_path / file, "--max-px", "9")
    assert told.status == 0, told.stderr
    found = read_calibration(tmp_path / file).cameras
    assert sorted(found) == sorted(names)
    true = read_rig(rig).cameras
    first = true[names[0]].T_world_color
    for name in names:
        assert np.allclose(np.linalg.inv(first) @ true[name].T_world_color, found[name].T_world_color, atol=1e-6)


def test_ros_takes_names_of_its_own_only(run, named, tmp_path):
    _, rig, names = named
    told = run("export", rig, "--to", "ros", tmp_path / "ros")
    assert "Traceback" not in told.stderr
    if all(re.fullmatch(r"\w+", name, re.ASCII) for name in names):
        assert told.status == 0 and sorted(read_calibration(tmp_path / "ros").cameras) == sorted(names)
    else:
        assert told.status == 2 and "camera names of ROS are letters, digits and underscores" in told.stderr


def image(folder: Path, camera: str, frame: str) -> None:
    save_color(folder, camera, frame, np.full((48, 64, 3), 90, np.uint8))
    save_depth(folder, camera, frame, np.full((48, 64), 2000, np.uint16))


@pytest.mark.parametrize("names", NAMES.values(), ids=NAMES)
def test_init_finds_cameras_of_any_name(run, tmp_path, names):
    for name in names:
        for k in range(3):
            image(tmp_path, name, f"{{{k}}} #[{k}]")
    told = run("init", tmp_path, "--yes", "--depth-scale", "0.001")
    assert told.status == 0, told.stderr
    recording = open_recording(tmp_path)
    assert sorted(recording.cameras) == sorted(names)
    for name in names:
        assert len(recording.color_files[name]) == len(recording.depth_files[name]) == 3


def test_braces_of_names_are_written_twice_in_patterns(tmp_path):
    for name in ("a", "b"):
        for k in range(2):
            path = tmp_path / f"{{{name}}}_{{{k}}}.png"
            assert cv2.imwrite(str(path), np.zeros((4, 4, 3), np.uint8))
    patterns = FilePatterns("{{{camera}}}_{{{frame}}}.png")
    patterns.check(["a", "b"])
    found = patterns.find(tmp_path, ["a", "b"])["color"]
    assert {c: list(own) for c, own in found.items()} == {"a": ["0", "1"], "b": ["0", "1"]}
    for wrong in ("{camera}/{{0}_{frame}.png", "{camera}/{0}_{frame}.png", "{camera}/{frame}}.png"):
        with pytest.raises(ValueError, match="written twice"):
            FilePatterns(wrong).check(["a", "b"])


@pytest.mark.parametrize("name", ["a:b", "a\\b", " x", "x ", ".a", "a\tb"])
def test_names_that_no_folder_can_have_everywhere_are_shown_and_refused(name):
    with pytest.raises(ValueError, match=f"a camera's name is that of its folder.*{re.escape(repr(name))} seen"):
        check_name(name)

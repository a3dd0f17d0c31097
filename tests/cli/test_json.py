"""--json: standard output is one JSON value with the numbers of the result, and nothing else."""

from __future__ import annotations

import json

import click
import pytest

from rgbd_calib.cli.main import cli
from rgbd_calib.io.recording import open_recording

WITHOUT = {
    "board": "a drawing",
    "board-shape": "one file",
    "cache": "no result",
    "capture": "a dialogue",
    "schema": "prints JSON anyway",
    "simulate": "truth.yaml has all numbers",
    "view": "a window",
}
"""Commands without --json, and why."""


def test_every_command_with_a_result_has_json():
    context = click.Context(cli)
    names = cli.list_commands(context)
    assert set(WITHOUT) <= set(names)
    for name in names:
        has = any("--json" in option.opts for option in cli.get_command(context, name).params)
        assert has != (name in WITHOUT), name


def test_fuse(run, tiny, tmp_path):
    out = run("fuse", tiny.recording, "--rig", tiny.rig_path, "--image", "-o", tmp_path / "c.ply", "--json")
    numbers = json.loads(out.stdout)
    assert f"element vertex {numbers['points']}\n".encode() in (tmp_path / "c.ply").read_bytes()
    assert numbers["points"] == sum(own["points"] for own in numbers["cameras"].values())
    assert numbers["frame"] == "000000" and set(numbers["pictures"]) == {"front", "top"}


def test_correct(run, tiny, tmp_path):
    out = run("correct", tiny.recording, "--rig", tiny.rig_path, "-o", tmp_path / "r", "--json")
    done, written = json.loads(out.stdout)["cameras"], open_recording(tmp_path / "r")
    assert {c: own["color_images"] for c, own in done.items()} == {c: len(f) for c, f in written.color_files.items()}
    assert {c: own["depth_images"] for c, own in done.items()} == {c: len(f) for c, f in written.depth_files.items()}


@pytest.mark.parametrize(("to", "name"), [("ros", "ros"), ("opencv", "rig.yml")])
def test_export_and_import_calibration(run, tiny, tmp_path, to, name):
    out = run("export", tiny.rig_path, "--to", to, tmp_path / name, "--json")
    numbers = json.loads(out.stdout)
    assert numbers["format"] == to
    folder = tmp_path / name if to == "ros" else tmp_path
    assert numbers["files"] and all((folder / file).is_file() for file in numbers["files"])
    if to == "opencv":
        read = run("import-calibration", tmp_path / name, "-o", tmp_path / "again.yaml", "--json")
        numbers = json.loads(read.stdout)
        assert set(numbers["cameras"]) == {"C1", "C2", "C3"}
        assert numbers["cameras"]["C1"]["intrinsics"]["fx"] == pytest.approx(60.0)


def test_report(run, tiny, tmp_path):
    out = run("report", tiny.rig_path, "-o", tmp_path, "--json")
    numbers = json.loads(out.stdout)
    assert numbers["verdict"] == "unknown" and set(numbers["cameras"]) == {"C1", "C2", "C3"}
    assert numbers["cameras"]["C2"]["position_m"] == pytest.approx([0.6, 0.05, 0.1])

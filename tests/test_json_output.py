"""--json: one JSON value on standard output and nothing beside it; what is not finite is null."""

import json

import pytest
from small_recording import draw_recording


def strict(text: str):
    def refuse(word: str):
        raise AssertionError(f"{word} is no JSON")

    return json.loads(text, parse_constant=refuse)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    return draw_recording(tmp_path_factory.mktemp("json") / "in", cameras=2, frames=9)


def results(run, *args):
    out = run(*args, "--json")
    assert out.status == 0, out.stderr
    return strict(out.stdout)


def test_commands_that_look_for_a_board(run, drawn, tmp_path):
    found = results(run, "detect", drawn, "-o", tmp_path / "corners.csv")
    assert set(found["cameras"]) == {"C1", "C2"}
    own = found["cameras"]["C1"]
    assert own["images"] == 9 and own["views"] + len(own["not_found"]) == 9
    lenses = results(run, "intrinsics", drawn, "--corners", tmp_path / "corners.csv", "-o", tmp_path / "lens.yaml")
    assert lenses["cameras"]["C1"]["intrinsics"]["fx"] == pytest.approx(575, rel=0.02)
    assert len(lenses["cameras"]["C1"]["intrinsics_sd"]) == 9
    bias = results(
        run, "depth-bias", drawn, "--intrinsics", tmp_path / "lens.yaml", "--corners", tmp_path / "corners.csv",
        "-o", tmp_path / "bias.yaml",
    )  # fmt: skip
    assert bias["cameras"]["C2"]["distances"] > 3 and bias["output"] == str(tmp_path / "bias.yaml")


def test_commands_that_use_a_rig(run, tiny, tmp_path):
    fused = results(run, "fuse", tiny.recording, "--rig", tiny.rig_path, "-o", tmp_path / "a.ply", "--view", "front")
    assert fused["points"] == sum(own["points"] for own in fused["cameras"].values()) and "front" in fused["pictures"]
    corrected = results(run, "correct", tiny.recording, "--rig", tiny.rig_path, "-o", tmp_path / "corrected")
    assert corrected["cameras"]["C1"]["depth_images"] == 2
    exported = results(run, "export", tiny.rig_path, "--to", "kalibr", tmp_path / "camchain.yaml", "--max-px", "5")
    assert exported["files"] == [str(tmp_path / "camchain.yaml")]
    imported = results(run, "import-calibration", tmp_path / "camchain.yaml", "-o", tmp_path / "back.yaml")
    assert imported["rig"] and len(imported["cameras"]) == 3


def test_every_command_with_results_has_json():
    """Commands without are those that start something, draw something, or print a document."""
    import click

    from rgbd_calib.cli.main import cli

    context = click.Context(cli)
    without = {
        name
        for name in cli.list_commands(context)
        if not any("--json" in p.opts for p in cli.get_command(context, name).params)
    }
    assert without <= {"simulate", "board", "board-shape", "view", "report", "capture", "cache", "schema"}

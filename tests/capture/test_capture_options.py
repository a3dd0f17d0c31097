"""Options of `capture` that contradict each other, before any camera is looked for."""

from __future__ import annotations

import pytest

BOARD = ("--board", "9x6", "--square", "0.06")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--on-still"], "--on-still: no board given"),
        (["--intrinsic", "--depth-bias"], "both given"),
        (["--wave", "5", "--on-still", "--board", "9x6", "--square", "0.06"], "--wave records every frame"),
        (["--until-mm", "1", "--intrinsic", *BOARD], "--until-mm records the board before the whole rig"),
        (["--until-mm", "1", "--wave", "5", *BOARD], "--until-mm records the board before the whole rig"),
        (["--until-mm", "1", "--depth-bias"], "--until-mm records the board before the whole rig"),
        (["--until-mm", "1", "--snapshot"], "--until-mm records the board before the whole rig"),
        (["--until-mm", "1", "--until-enough", *BOARD], "--until-mm records the board before the whole rig"),
        (["--until-mm", "1"], "--until-mm: no board given"),
        (["--until-mm", "0", *BOARD], "is not in the range"),
        (["--board", "9by6", "--square", "0.06"], "--board 9by6"),
        (["--board", "9x6"], "--square M expected beside it"),
        (["--append", "--on-still"], "no board is named there"),
        (["--device", "C1"], "ID=SERIAL needed"),
        (["--distances", "1,2"], "--distances belongs to --depth-bias"),
        (["--depth-bias", "--distances", "1,x"], "metres between commas"),
        (["--preview", "here"], "PORT or HOST:PORT needed"),
    ],
)
def test_options_that_make_no_sense(run, tmp_path, options, message):
    outcome = run("capture", tmp_path / "out", *options)
    assert outcome.status == 2 and message in outcome.stderr

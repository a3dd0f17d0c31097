"""The entry point itself: help is quick, a wrong command is a usage error with a suggestion."""

import subprocess
import sys

import click
import pytest

from rgbd_calib.cli.main import COMMANDS
from rgbd_calib.pipeline.summary import course, merged
from rgbd_calib.quality import Quality


def test_a_dropped_frame_is_named_as_people_know_it():
    assert course(Quality(dropped={"C1": {"C1 alone: 101017": "outlier", "000003": "outlier"}})) == [
        "C1: frame 101017 of its intrinsic recording dropped: outlier",
        "C1: frame 000003 dropped: outlier",
    ]


def test_help_lists_the_commands_in_the_order_of_the_work(run):
    outcome = run("--help")
    assert outcome.status == 0
    listed = [line.split()[0] for line in outcome.stdout.split("Commands:")[1].splitlines() if line[:2] == "  "]
    listed = [word for word in listed if word in COMMANDS]
    assert listed and listed == [name for name in COMMANDS if name in listed]


def test_a_misspelt_command_is_a_usage_error_with_a_suggestion(run):
    outcome = run("calibarte")
    assert outcome.status == 2
    assert "did you mean 'calibrate'?" in outcome.stderr
    assert "Traceback" not in outcome.stderr


def test_without_a_command_it_says_where_to_start(run):
    outcome = run()
    assert outcome.status == 2 and outcome.stdout == ""
    assert "Where to start:" in outcome.stderr and "rgbd-calib simulate demo" in outcome.stderr


def test_every_command_can_be_quiet_and_keep_a_log(run):
    for name in COMMANDS:
        text = run(name, "--help").stdout
        assert "--quiet" in text and "--log-file" in text, name


def test_quiet_says_only_what_is_wrong_and_the_log_has_all(run, tiny, tmp_path):
    log = tmp_path / "log.txt"
    common = ("fuse", tiny.recording, "--rig", tiny.rig_path, "--frame", "000000", "-o", tmp_path / "a.ply")
    out = run(*common, "--quiet", "--log-file", log)
    assert out.status == 0 and out.stderr == ""
    assert "points of 2 cameras" in log.read_text() and log.read_text()[:2] == "20"
    out = run(*common, "--quiet")
    assert out.status == 2 and "exists already" in out.stderr
    bad = run(*common, "--overwrite", "--log-file", tmp_path / "none" / "log.txt")
    assert bad.status == 2 and "cannot be written" in bad.stderr


def test_the_same_remark_for_several_cameras_is_one_line():
    said = [f"{name}'s fx is held: film more" for name in ("C1", "C10", "C2")] + ["C1: late", "The board moved"]
    assert merged(said, ["C1", "C2", "C10"]) == ["C1, C10, C2's fx is held: film more", "C1: late", "The board moved"]


def test_help_imports_nothing_heavy():
    heavy = ("numpy", "scipy", "cv2", "open3d", "pydantic", "rich", "PIL", "yaml", "plotly")
    script = (
        "import sys; from rgbd_calib.cli.main import main; sys.argv = ['rgbd-calib', '--help']\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        f"print([m for m in {heavy} if m in sys.modules], file=sys.stderr)"
    )
    out = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert out.stderr.strip() == "[]"


def test_the_estimate_starts_without_what_takes_long_to_import():
    """scipy.stats, and what imports it, takes a second for two functions."""
    slow = ("open3d", "matplotlib", "plotly", "scipy.stats", "scipy.signal", "scipy.optimize", "scipy.interpolate")
    script = f"import sys, rgbd_calib.api; print([m for m in {slow} if m in sys.modules])"
    assert subprocess.check_output([sys.executable, "-c", script], text=True).strip() == "[]"


def test_every_number_among_the_options_is_finite():
    """inf is larger than every limit, and nan is within every range."""
    from rgbd_calib.cli.main import cli
    from rgbd_calib.cli.options import Number

    seen = 0
    for name in cli.list_commands(click.Context(cli)):
        command = cli.get_command(click.Context(cli), name)
        for param in command.params:
            if isinstance(param.type, click.types.FloatParamType):
                assert isinstance(param.type, Number), f"{name} {param.opts}"
                seen += 1
    assert seen > 30
    for text in ("nan", "inf", "-inf"):
        with pytest.raises(click.BadParameter):
            Number().convert(text, None, None)


@pytest.mark.parametrize("limit", ["inf", "nan", "1e9"])
def test_verify_has_no_limit_that_everything_passes(run, limit):
    out = run("verify", "rig.yaml", "new", "--max-mm", limit)
    assert out.status == 2
    assert "--max-mm" in out.stderr

"""The entry point itself: help is quick, a wrong command is a usage error with a suggestion."""

import subprocess
import sys

from rgbd_calib.cli.main import COMMANDS


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

"""The command `rgbd-calib`: one subcommand a module, imported when it is asked for."""

from __future__ import annotations

import copy
import importlib
import importlib.util
import io
import os
import signal
import sys
from contextlib import suppress
from types import FrameType

import click

from rgbd_calib.cli.streams import common_options, results_apart, say, standard_streams
from rgbd_calib.errors import RgbdCalibError

COMMANDS = (
    "devices",
    "capture",
    "init",
    "import",
    "import-calibration",
    "doctor",
    "simulate",
    "detect",
    "intrinsics",
    "depth-bias",
    "calibrate",
    "refine",
    "evaluate",
    "verify",
    "monitor",
    "sync",
    "report",
    "view",
    "fuse",
    "correct",
    "export",
    "board",
    "board-shape",
    "schema",
    "cache",
)
"""In the order of the work. Command `a-b` is `command` in module `rgbd_calib.cli.a_b` (`import_` for `import`)."""


START = """Where to start:

  without cameras        rgbd-calib simulate demo
                         rgbd-calib calibrate demo/extrinsic -o demo/rig.yaml --report demo/report
  with cameras           rgbd-calib devices
                         rgbd-calib capture rig1 --board 9x6 --square 0.06 --until-mm 1.5 --preview
                         rgbd-calib calibrate rig1 -o rig.yaml
  with a recording       rgbd-calib doctor RECORDING
                         rgbd-calib calibrate RECORDING -o rig.yaml --report report
  images in a folder     rgbd-calib init FOLDER --board 9x6 --square 0.06
  bags, videos           rgbd-calib import FILE -o RECORDING --board 9x6 --square 0.06

All commands: rgbd-calib --help. One of them: rgbd-calib COMMAND --help."""


def _module(name: str) -> str:
    return "rgbd_calib.cli." + ("import_" if name == "import" else name.replace("-", "_"))


class _Commands(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        return [name for name in COMMANDS if importlib.util.find_spec(_module(name))]

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in COMMANDS:
            return None
        command: click.Command = copy.copy(importlib.import_module(_module(name)).command)
        assert command.callback is not None
        command.callback = results_apart(command.callback)
        command.params = [*command.params, *common_options()]
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and args[0] not in COMMANDS:
            from difflib import get_close_matches

            near = get_close_matches(args[0], COMMANDS, 1)
            ctx.fail(
                f"no command '{args[0]}'" + (f"; did you mean '{near[0]}'?" if near else "; see rgbd-calib --help")
            )
        return super().resolve_command(ctx, args)


@click.group(
    cls=_Commands,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)
@click.version_option(package_name="rgbd-calib")
@click.pass_context
def cli(context: click.Context) -> None:
    """Calibrate a rig of RGB-D cameras: poses, intrinsics and depth bias, with the error in millimetres.

    \b
    A rig in three commands:
      rgbd-calib capture rig1 --board 9x6 --square 0.06 --until-mm 1.5 --preview
      rgbd-calib calibrate rig1 -o rig.yaml
      rgbd-calib fuse rig1 --rig rig.yaml -o cloud.ply

    \b
    Without cameras:
      rgbd-calib simulate demo
      rgbd-calib calibrate demo/extrinsic -o demo/rig.yaml
    """
    if context.invoked_subcommand is None:
        click.echo(START, err=True)
        context.exit(2)


class _Terminated(SystemExit):
    """TERM or HUP came: what is being written is taken away on the way out, as after Ctrl-C."""


def _terminate(number: int, frame: FrameType | None) -> None:
    raise _Terminated(128 + number)


def main() -> None:
    """Entry point: user errors end in one line on stderr and their exit status, Ctrl-C in 130, TERM in 143."""
    for number in {signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)}:
        if signal.getsignal(number) is signal.SIG_DFL:  # nohup ignores HUP
            with suppress(ValueError):  # called outside the main thread
                signal.signal(number, _terminate)
    with standard_streams() as lost:
        status = _run()
        error = lost()
        if error is not None and status == 0:
            say(f"Error: standard output: {error.strerror}, so the results are incomplete. Write them elsewhere")
            status = 2
    sys.exit(status)


def _run() -> int:
    """Run the command line; its exit status."""
    try:
        status = cli.main(standalone_mode=False)
    except click.ClickException as error:
        text = io.StringIO()
        error.show(text)
        say(text.getvalue().rstrip())
        return error.exit_code
    except click.exceptions.Abort:
        say("Interrupted; nothing was left half-written.")
        return 130
    except _Terminated as error:
        say("Terminated; nothing was left half-written.")
        return int(error.code or 0)
    except RgbdCalibError as error:
        say(f"Error: {error}")
        return error.exit_status
    except OSError as error:
        name = os.fsdecode(error.filename) if isinstance(error.filename, str | bytes) else "a file"
        say(f"Error: {name}: {error.strerror or error}. Fix this and run again")
        return 2
    except MemoryError:
        say("Error: not enough memory. Free some, or take fewer images")
        return 1
    return status if isinstance(status, int) else 0

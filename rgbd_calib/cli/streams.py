"""Standard output is for results only, and a closed pipe (`| head`) does not stop a command.

While a command runs, everything that libraries print, from Python or C, goes to standard error; results go to standard
output through :func:`show`. After the reader has closed the pipe, further results are dropped: the command finishes, its
files are written, and the exit status is its own.
"""

from __future__ import annotations

import io
import os
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from functools import wraps
from pathlib import Path
from typing import Any, TextIO

import click

from rgbd_calib.errors import RgbdCalibError

_RESULTS, _JSON, _QUIET, _LOG = (f"{__name__}.{name}" for name in ("results", "json", "quiet", "log"))


def show(text: str) -> None:
    """Print a result, on standard output; nothing where results are wanted as JSON."""
    meta = click.get_current_context().meta
    if not meta.get(_JSON):
        click.echo(_printable(text), file=meta.get(_RESULTS))


def give(numbers: Any) -> None:
    """Print the results as JSON, where --json was given."""
    meta = click.get_current_context().meta
    if meta.get(_JSON):
        from rgbd_calib.io.plain import to_json

        click.echo(to_json(numbers, indent=2), file=meta.get(_RESULTS))


def say(text: str, always: bool = False) -> None:
    """Print a message for the user, on standard error; with --quiet only what is said `always`: warnings and errors."""
    context = click.get_current_context(silent=True)
    meta = context.meta if context is not None else {}
    if always or not meta.get(_QUIET):
        click.echo(_printable(text), err=True)
    _log(text, meta)


def _log(text: str, meta: Mapping[str, Any]) -> None:
    if path := meta.get(_LOG):
        with path.open("a", encoding="utf-8") as log:
            log.write(f"{time.strftime('%Y-%m-%dT%H:%M:%S')} {_printable(text)}\n")


def _remember(key: str) -> Callable[[click.Context, click.Parameter, Any], Any]:
    def remember(context: click.Context, parameter: click.Parameter, value: Any) -> Any:
        context.meta[key] = value
        return value

    return remember


def common_options() -> list[click.Parameter]:
    """--quiet and --log-file, which every command has."""
    return [
        click.Option(
            ["--quiet"], is_flag=True, expose_value=False, callback=_remember(_QUIET), help="Only warnings and errors."
        ),
        click.Option(
            ["--log-file"],
            type=click.Path(path_type=Path, dir_okay=False),
            expose_value=False,
            callback=_log_file,
            help="Append all messages to this file, with the time.",
        ),
    ]


def _log_file(context: click.Context, parameter: click.Parameter, path: Path | None) -> Path | None:
    if path is not None:
        if os.path.exists(path) and not (
            path.is_file() or path.is_char_device()
        ):  # opening a pipe waits for its reader
            raise click.BadParameter(f"{path}: a regular file expected, something else found. Choose another file")
        try:
            with path.open("a+b") as stream:
                stream.seek(0)
                begin = stream.read(20) if path.is_file() else b""
        except OSError as error:
            raise click.BadParameter(f"{path} cannot be written: {error.strerror}. Choose another file") from None
        if begin and not re.match(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d ", begin):
            raise click.BadParameter(
                f"{path}: a log, or no file yet, expected; something else found. Choose another file"
            )
        context.meta[_LOG] = path
    return path


def json_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """--json: :func:`show` is silent, and :func:`give` prints."""
    help_text = "Print the results as JSON."
    return click.option("--json", is_flag=True, expose_value=False, callback=_remember(_JSON), help=help_text)(command)


@contextmanager
def _logging() -> Iterator[None]:
    """Messages of the library's logger are said to the user; warnings always."""
    import logging

    class Said(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            say(record.getMessage(), always=record.levelno >= logging.WARNING)

    logger, handler = logging.getLogger("rgbd_calib"), Said()
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)


def results_apart(callback: Callable[..., Any]) -> Callable[..., Any]:
    """The body of a command, with its `show` on standard output and all that is printed otherwise on standard error."""

    @wraps(callback)
    def run(*args: Any, **options: Any) -> Any:
        meta = click.get_current_context().meta
        meta[_RESULTS] = sys.stdout
        try:
            with redirect_stdout(sys.stderr), _logging():
                return callback(*args, **options)
        except (RgbdCalibError, OSError) as error:  # told to the user once the command's context is gone
            _log(f"Error: {error}", meta)
            raise

    return run


class _Output(io.FileIO):
    """A descriptor whose errors come at the end: work does not stop because nobody can read of it."""

    failed: OSError | None = None

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError as error:
            self.failed = self.failed or error
            return len(data)


@contextmanager
def standard_streams() -> Iterator[Callable[[], OSError | None]]:
    """Standard streams that outlive their readers, and standard output for nothing but Python's own.

    Yields
    ------
    A function that flushes, and gives the error that results were lost by, such as a full disk; None where nothing
    was lost, or nobody wanted it.
    """
    _open_closed()
    sys.stdout = sys.stdout or os.fdopen(1, "w", closefd=False)
    sys.stderr = sys.stderr or os.fdopen(2, "w", closefd=False)
    if not (_is_descriptor(sys.stdout, 1) and _is_descriptor(sys.stderr, 2)):  # a notebook, a test
        yield lambda: None
        return
    sys.stdout.flush()
    before = sys.stdout, sys.stderr
    own = os.dup(1)
    results, messages = _Output(own, "wb"), _Output(2, "wb", closefd=False)
    os.dup2(2, 1)
    sys.stdout, sys.stderr = _text(results, before[0]), _text(messages, before[1])

    def lost() -> OSError | None:
        sys.stdout.flush()
        failed = results.failed
        return None if isinstance(failed, BrokenPipeError) else failed

    try:
        yield lost
    finally:
        sys.stderr.flush()
        os.dup2(own, 1)
        sys.stdout.close()
        sys.stdout, sys.stderr = before


def _open_closed() -> None:
    """Open what was closed (`>&-`), or the next file that is opened would be standard output to a library."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free


def _is_descriptor(stream: TextIO | None, number: int) -> bool:
    try:
        return stream is not None and stream.fileno() == number
    except (OSError, ValueError):
        return False


def _text(raw: _Output, like: TextIO) -> TextIO:
    """A text stream over `raw`; characters that its encoding lacks are escaped."""
    return io.TextIOWrapper(
        io.BufferedWriter(raw), encoding=like.encoding, errors="backslashreplace", line_buffering=True
    )


def _printable(text: str) -> str:
    from rgbd_calib.io.text import printable

    return printable(text)

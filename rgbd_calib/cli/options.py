"""Options and habits that several commands share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import click

from rgbd_calib.errors import ConfigError

T = TypeVar("T")
Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

recording_argument = click.argument("recording", type=click.Path(path_type=Path))
overwrite_option = click.option("--overwrite", is_flag=True, help="Replace what is there.")
seed_option = click.option("--seed", type=int, default=0, show_default=True, help="Seed of every random choice.")
jobs_option = click.option(
    "--jobs", type=click.IntRange(1), default=None, help="Processes to use.  [default: as many as there are cores]"
)


def output_option(what: str, required: bool = True) -> Decorator:
    """-o/--output FILE, described by `what`."""
    return click.option(
        "-o", "--output", type=click.Path(path_type=Path), required=required, help=f"Where to write {what}."
    )


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Stop before any work where the result would replace something."""
    if path.exists() and not overwrite:
        raise ConfigError(f"{path}: exists already. Choose another name, or replace it with --overwrite")


def progress(items: Iterable[T], total: int, what: str) -> Iterator[T]:
    """The items, with a progress bar on stderr (none where stderr is not a terminal)."""
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    yield from track(items, description=what, total=total, console=console, disable=not console.is_terminal)


def say(text: str) -> None:
    """Talk to the user, on stderr: stdout is for results."""
    click.echo(text, err=True)

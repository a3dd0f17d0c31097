"""Commands in the texts that people read: README, docs, the examples of --help."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rgbd_calib.cli.main import COMMANDS, cli

ROOT = Path(__file__).parents[2]
PROGRAMS = ("rgbd-calib", "python", "scripts/demo", "scripts/test")
MARKER = re.compile(r"<!-- run: (?P<how>[^;>]+?)(; (?P<why>[^>]+?))? -->\s*$")

NOT_RUN = {
    "capture": "needs cameras",
    "devices": "needs cameras",
    "simulate": "takes minutes; tests/test_simulate.py runs it, small",
    "calibrate demo/extrinsic --world floor": "the drawn recording has no floor; tests/test_calibrate.py runs it",
    "calibrate demo/extrinsic --intrinsics demo/intrinsic --depth-bias": "docs/start/own_rig.md has it under other names",
    "calibrate rig1 -o": "docs/start/own_recording.md runs the same",
    "sync": "needs a carried board with timestamps; tests/test_cli_sync.py runs it",
    "monitor": "runs until it is stopped; tests/test_monitor.py runs it",
    "calibrate monday --update rig.yaml --snapshot": "needs an empty scene; tests/test_snapshot.py has one",
    "verify rig.yaml monday --snapshot": "the same",
    "evaluate rig.yaml --clouds": "the same; tests/test_clouds.py runs it",
    "refine rig.yaml --clouds": "the same; tests/trust/test_refine_clouds.py runs it",
    "view": "waits for its window",
    "import left.oni": "needs the OpenNI2 runtime; tests/test_import.py runs it",
    "import rig.mcap": "tests/test_import_bags.py runs it on bags that it writes",
}
"""Commands of --help, by their beginning, of which only the options are checked, and why."""


@dataclass(frozen=True)
class Printed:
    """One command as printed.

    `how` is "parse" (its options are checked), "skip", or the exit status that it must have.
    """

    source: str
    line: str
    how: str = "0"

    @property
    def parts(self) -> list[list[str]]:
        """The commands that the shell would join by && and ||, each as its words; a redirection is left out."""
        words, parts = shlex.split(self.line, comments=True), [[]]
        for word in words:
            if word in ("&&", "||"):
                parts.append([])
            else:
                parts[-1].append(word)
        return [part[: part.index(">")] if ">" in part else part for part in parts]


def of_help() -> Iterator[Printed]:
    """Examples of `rgbd-calib --help` and of each command's."""
    for name in (None, *COMMANDS):
        command = cli if name is None else cli.get_command(None, name)
        for line in (command.help or "").splitlines():
            if line.strip().startswith("rgbd-calib "):
                yield _with_exceptions(Printed(f"{name or 'rgbd-calib'} --help", line.strip()))


def _with_exceptions(printed: Printed) -> Printed:
    rest = printed.line.removeprefix("rgbd-calib ")
    lone = any(rest.startswith(start) for start in NOT_RUN) and "--save" not in rest and "replay:" not in rest
    return Printed(printed.source, printed.line, "parse") if lone else printed


def of_page(path: Path) -> Iterator[Printed]:
    """Commands in the fenced blocks of a Markdown page.

    A block with prompts has commands in its lines with `$ ` only. An HTML comment right above the block says how it is run:
    `<!-- run: parse; why -->`, `<!-- run: exit 1 -->`.
    """
    how, inside, previous = "0", False, ""
    block: list[str] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.lstrip().startswith("```"):
            if inside:
                yield from _of_block(str(path.relative_to(ROOT)), block, how)
            else:
                marker = MARKER.search(previous)
                how = marker["how"].removeprefix("exit ") if marker else "0"
            inside, block = not inside, []
        elif inside:
            block.append(line.strip())
        if line.strip():
            previous = line


def _of_block(source: str, block: list[str], how: str) -> Iterator[Printed]:
    prompts = [line.removeprefix("$ ") for line in block if line.startswith("$ ")]
    for line in prompts or block:
        if line.startswith(PROGRAMS):
            yield _with_exceptions(Printed(source, line, how)) if how == "0" else Printed(source, line, how)


def pages() -> list[Path]:
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def inline(path: Path) -> Iterator[str]:
    """Commands inside sentences, which may hold placeholders such as RIG."""
    text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.S)
    yield from (
        found for found in re.findall(r"`([^`\n]+)`", text) if found.startswith(("rgbd-calib ", "python scripts/"))
    )

"""Every command printed in README, docs and --help is run, in order, in an empty folder, and ends with the status beside it."""

from __future__ import annotations

import ast
import re
import shutil
from itertools import groupby, pairwise
from pathlib import Path

import click
import printed_commands
import printed_world
import pytest
from printed_commands import ROOT, Printed

from rgbd_calib.cli.main import COMMANDS, cli


@pytest.fixture(scope="module")
def printed() -> list[Printed]:
    return [
        *(c for page in printed_commands.pages() for c in printed_commands.of_page(page)),
        *printed_commands.of_help(),
    ]


def words_that_are_wrong(words: list[str]) -> str:
    """What click says of a command line that it does not take; empty for a good one."""
    if words[0] == "python":
        return script_that_is_wrong(words)
    if words[0].startswith("scripts/"):
        return "" if (ROOT / words[0]).exists() else f"no {words[0]}"
    if len(words) == 1:
        return ""
    command = cli.get_command(None, words[1]) if words[1] in COMMANDS else None
    if command is None:
        return "" if words[1].startswith("-") else f"no command {words[1]}"
    try:
        command.make_context(words[1], words[2:])
    except click.exceptions.Exit:
        return ""
    except click.ClickException as error:
        return error.format_message()
    return ""


def script_that_is_wrong(words: list[str]) -> str:
    path = ROOT / words[1]
    if not path.exists():
        return f"no {words[1]}"
    text = path.read_text(encoding="utf-8")
    unknown = [word for word in words if word.startswith("--") and f'"{word.split("=")[0]}"' not in text]
    return f"{words[1]} has no {', '.join(unknown)}" if unknown else ""


class Folder:
    """An empty folder of one text; what its commands read and no earlier one wrote is taken from the world."""

    def __init__(self, path: Path, world: Path) -> None:
        self.path, self.world = path, world
        path.mkdir()

    def provide(self, words: list[str]) -> None:
        outputs = {after for word, after in pairwise(words) if word in ("-o", "--save", "--correspondences")}
        for word in words[2:]:
            name = word.split("=")[-1].removeprefix("replay:").rstrip("/")
            there, here = self.world / name, self.path / name
            if name.startswith("-") or word in outputs or here.exists() or not (name and there.exists()):
                continue
            here.parent.mkdir(parents=True, exist_ok=True)
            for one in (there, *there.parent.glob(f"{there.stem}.residuals.csv")):
                target = here.with_name(one.name)
                if not target.exists():
                    (shutil.copytree if one.is_dir() else shutil.copy)(one, target)  # type: ignore[operator]


def test_every_printed_command_ends_as_it_says(printed, run, tmp_path, monkeypatch):
    def made(*args: object) -> None:
        outcome = run(*args)
        assert outcome.status == 0, outcome.stderr

    world = printed_world.build(tmp_path / "world", made)
    failed = []
    for number, (source, commands) in enumerate(groupby(printed, lambda c: c.source)):
        folder = Folder(tmp_path / f"{number}", world)
        monkeypatch.chdir(folder.path)
        for command in commands:
            for words in command.parts:
                if words[0] != "rgbd-calib" or command.how == "parse":
                    said = words_that_are_wrong(words)
                elif command.how == "skip":
                    said = ""
                else:
                    folder.provide(words)
                    outcome = run(*words[1:])
                    said = (
                        "" if outcome.status == int(command.how) else f"exit {outcome.status}: {outcome.stderr[-600:]}"
                    )
                if said:
                    failed.append(f"{source}: {' '.join(words)}\n    {said}")
    assert not failed, f"{len(failed)} failed\n" + "\n".join(failed)


def test_enough_was_found(printed):
    assert len(printed) >= 60 and len({c.source for c in printed}) >= 20


@pytest.mark.parametrize("page", printed_commands.pages(), ids=lambda p: str(p.relative_to(ROOT)))
def test_commands_inside_sentences_exist(page):
    for line in printed_commands.inline(page):
        words = line.split()
        if words[0] == "python":
            assert not script_that_is_wrong(words), line
        elif words[1].isalpha() and words[1].islower():
            assert words[1] in COMMANDS, line
            known = {name for p in cli.get_command(None, words[1]).params for name in (*p.opts, *p.secondary_opts)}
            assert not {w for w in words if w.startswith("--")} - known - {"--help"}, line


def test_commands_that_messages_name_exist():
    for path in sorted((ROOT / "rgbd_calib").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                for name in re.findall(r"`?rgbd-calib ([a-z]+(?:-[a-z]+)*)\b", node.value):
                    context = node.value[:200]
                    assert name in COMMANDS or not re.search(rf"`rgbd-calib {name}", node.value), f"{path}: {context}"

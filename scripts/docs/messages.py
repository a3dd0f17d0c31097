"""All texts that the program may show, in one page for review: read from the source, by file."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "rgbd_calib"


def texts(path: Path) -> Iterator[tuple[int, str]]:
    """(line, text) of the strings of a module that read as sentences, values as {}; docstrings are not among them."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    docs = {
        id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    inside = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in ast.walk(node)} - {
        id(node) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr)
    }
    for node in ast.walk(tree):
        if id(node) in docs or id(node) in inside:
            continue
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            text = node.value
        elif isinstance(node, ast.JoinedStr):
            text = "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
        else:
            continue
        if text.count(" ") >= 2 and any(word.isalpha() and len(word) > 2 for word in text.split()):
            yield node.lineno, " ".join(text.split())


def help_texts() -> Iterator[tuple[str, str]]:
    """(command, its help and that of its options)."""
    from rgbd_calib.cli.main import COMMANDS, cli

    for name in (None, *COMMANDS):
        command = cli if name is None else cli.get_command(None, name)  # type: ignore[arg-type]
        assert command is not None
        yield name or "rgbd-calib", command.help or ""
        for param in command.params:
            if text := getattr(param, "help", None):
                yield f"{name} {param.opts[0]}", text


def by_file() -> dict[str, list[tuple[int, str]]]:
    found = {str(p.relative_to(PACKAGE.parent)): sorted(texts(p)) for p in sorted(PACKAGE.rglob("*.py"))}
    return {name: rows for name, rows in found.items() if rows}


def page() -> str:
    """The list as Markdown."""
    out = ["# Messages", "", "Texts in the source that a person may read, with values as `{}`.", ""]
    for name, rows in by_file().items():
        out += [f"## {name}", "", "```text", *(text for _, text in rows), "```", ""]
    return "\n".join(out)

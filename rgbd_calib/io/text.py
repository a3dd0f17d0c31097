"""Text that is valid in every file and terminal, also for file names that are not UTF-8."""

from __future__ import annotations

from collections.abc import Sequence


def valid(text: str) -> str:
    r"""The text in characters that UTF-8 can hold: a byte of a file's name that is not UTF-8 becomes `\xe9`.

    Python keeps such bytes as lone surrogates, which YAML and JSON readers refuse.
    """
    try:
        raw = text.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:  # surrogates that stand for no byte
        raw = text.encode("utf-8", "backslashreplace")
    return raw.decode("utf-8", "backslashreplace")


def printable(text: str) -> str:
    """The text for a terminal: lines as they are, every other control character escaped."""
    shown = (c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in valid(text))
    return "".join(shown)


def first_few(names: Sequence[str], most: int = 6) -> str:
    """Names in words: `a, b` or, of more than `most`, `a, b and 5 more`."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")

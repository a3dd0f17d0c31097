"""Texts that people read use the field's terms: none of the phrases that were replaced comes back."""

from __future__ import annotations

import re
import sys
from functools import lru_cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "scripts" / "docs"))
import messages  # noqa: E402  (a script of the documentation)

REPLACED = {
    r"\btalks? to std": "messages go to stderr",
    r"half[- ]turn": "180° rotation",
    r"quarter turn": "90° rotation",
    r"rig's own views must do": "intrinsics are then estimated from the rig's own views",
    r"lets expect": "as predicted by the joint covariance",
    r"no depth in it": "depth is not used",
    r"draws? whole boards": "bias whole boards",
    r"ends? silently wrong": "fails silently",
    r"looked at once": "detections are cached",
    r"\bdies of\b": "crashes on",
    r"what is left at every corner": "per-corner residuals",
    r"noise of single depths": "single-reading depth noise",
    r"weights and unknowns settled": "bundle adjustment converged",
    r"depth only: offset": "depth rejected as an outlier",
    r"\banew, and keep nothing": "ignore the detection cache",
    r"the workers that it has": "the cluster determines the number of workers",
    r"\bmend(s|ed)?\b": "fix",
    r"thing\(s\)": "problems",
    r"\btell by\b": "check from",
    r"\bstill holds?\b": "is still valid",
    r"\bgo(es)? on with\b": "resume",
    r"goes on where|went on where": "resumes",
    r"in good order": "cleanly",
    r"\bstands elsewhere": "moved",
    r"is another one": "changed",
    r"\blies beside\b": "is misregistered to",
    r"farther apart than its rows": "the printed squares are not square",
    r"\bcount with\b": "expect",
    r"as such rest on": "depends on",
    r"where the two stand": "relative pose",
    r"tell most": "most informative",
    r"how the word is chosen": "how the verdict is determined",
    r"(cannot|can|could) be told\b": "be distinguished, or determined",
}


@lru_cache
def pages() -> tuple[tuple[str, str], ...]:
    """Where, and what is read there, with its white space in one."""
    return tuple((where, " ".join(text.split())) for where, text in _pages())


def _pages():
    for path in (
        ROOT / "README.md",
        *sorted((ROOT / "docs").rglob("*.md")),
        *sorted((ROOT / "configs").glob("*.yaml")),
    ):
        yield str(path.relative_to(ROOT)), path.read_text(encoding="utf-8")
    for path in sorted((ROOT / "rgbd_calib").rglob("*")):
        if path.suffix in (".html", ".js"):
            yield str(path.relative_to(ROOT)), path.read_text(encoding="utf-8")
    yield from ((f"{name} --help", text) for name, text in messages.help_texts())
    yield from ((f"{name}:{line}", text) for name, rows in messages.by_file().items() for line, text in rows)


@pytest.mark.parametrize("phrase", REPLACED)
def test_a_replaced_phrase_is_gone(phrase):
    found = [(where, m.group(0)) for where, text in pages() for m in re.finditer(phrase, text, re.I)]
    assert not found, f"write '{REPLACED[phrase]}' in {found}"


def test_the_list_of_messages_has_them_all():
    text = messages.page()
    assert "Choose another name, or replace it with --overwrite" in text and text.count("\n") > 800

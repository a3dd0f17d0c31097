"""YAML from strangers: what would exhaust the reader, or mean two things, is refused with the line."""

from __future__ import annotations

import os

import pytest

from rgbd_calib.errors import ConfigError
from rgbd_calib.io import safe_yaml
from rgbd_calib.io.files import load_yaml


def bomb(levels: int) -> str:
    """A few hundred bytes that stand for 9^levels values."""
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, levels)]
    return "\n".join(lines)


def merge_bomb(levels: int) -> str:
    lines = ["a0: &a0 {x: 1, y: 1}"]
    lines += [f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}" for i in range(1, levels)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "needle"),
    [
        ("a: 1\nb: 2\na: 3", "line 3: key 'a' stands there twice"),
        ("a: {b: 1, 'b': 2}", "line 1: key 'b' stands there twice"),
        (bomb(9), "line 7: more than 2500000 values"),
        (merge_bomb(9), "more than 2500000 values"),
        ("[" * 200_000, "more than .* 64 levels"),  # libyaml's composer ends the process
        ("a:\n" + "".join(" " * i + "b:\n" for i in range(1, 100)), "64 levels"),
        ("a: &a [*a]", "'\\*a' stands for what is not complete there"),
        ("? [1, 2]\n: 3", "a key that is no word"),
        ("a: !!timestamp 2001-99-99", "tag .*timestamp' seen"),
        ("a: " + "9" * 5000, "a number of 5000 digits"),
        ("a: " + "1:" * 50_000 + "1", "a number of 100001 digits"),
        ("a: 0x_", "not valid YAML"),
        ("a: =", "not valid YAML"),
        ("a: 1\n--- b: 2", "not valid YAML"),
        ('a: "\\ud800"', "not valid YAML"),
        ("a: \x00", "not valid YAML"),
    ],
    ids=lambda value: value[:12],
)
def test_refused_with_the_line(text, needle):
    with pytest.raises(safe_yaml.UnsafeYaml, match=needle):
        safe_yaml.load(text)


def test_what_is_meant_as_text_stays_text():
    """YAML 1.1 would make False, 8, a date and a number of these keys and values."""
    text = "no: 2026-11-22\n000010: 1\n1.0: 2"
    assert safe_yaml.load(text) == {"no": "2026-11-22", "000010": 1, "1.0": 2}


def test_aliases_and_merges_within_reason_hold():
    text = "a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3}\nc: *a\nd: {<<: *a, x: 4}"
    a = {"x": 1, "y": 2}
    assert safe_yaml.load(text) == {"a": a, "b": {"x": 1, "y": 3}, "c": a, "d": {"x": 4, "y": 2}}


def test_a_merged_mapping_may_itself_be_merged_from_deeper_down():
    text = "base: &b {a: 1}\nmid: {x: {y: &m {<<: *b, a: 2}}}\ntop: {<<: *m, c: 1}"
    assert safe_yaml.load(text)["top"] == {"a": 2, "c": 1}


def test_the_size_is_bounded_before_it_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(safe_yaml, "MAX_BYTES", 1 << 20)
    (tmp_path / "a.yaml").write_bytes(b"a: 1\n" + b"#" * (1 << 20))
    with pytest.raises(ConfigError, match=r"a.yaml: larger than 1 MB"):
        load_yaml(tmp_path / "a.yaml")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_a_pipe_does_not_hang(tmp_path):
    os.mkfifo(tmp_path / "a.yaml")
    with pytest.raises(ConfigError, match=r"a.yaml: a regular file was expected"):
        load_yaml(tmp_path / "a.yaml")
    (tmp_path / "b.yaml").mkdir()
    with pytest.raises(ConfigError, match=r"b.yaml: a regular file was expected"):
        load_yaml(tmp_path / "b.yaml")

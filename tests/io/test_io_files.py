"""Files are written whole or not at all, and YAML keeps every bit of a number."""

import math
import os

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.files import dump_yaml, load_yaml, whole_file, whole_folder, write_text
from rgbd_calib.io.folders import MARKER
from rgbd_calib.io.plain import plain


def test_a_file_appears_whole(tmp_path):
    with whole_file(tmp_path / "deep" / "a.txt") as temporary:
        temporary.write_text("new")
        assert temporary.suffix == ".txt" and not (tmp_path / "deep" / "a.txt").exists()
    assert (tmp_path / "deep" / "a.txt").read_text() == "new"
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["a.txt"]


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path):
    (tmp_path / "a.txt").write_text("old")
    with pytest.raises(RuntimeError), whole_file(tmp_path / "a.txt") as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert (tmp_path / "a.txt").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


def test_permissions_are_those_of_any_new_file(tmp_path):
    (tmp_path / "usual").touch()
    write_text(tmp_path / "ours", "text")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "usual").stat().st_mode


def test_a_folder_appears_whole_and_replaces_only_when_asked(tmp_path):
    with whole_folder(tmp_path / "out") as folder:
        (folder / "a").write_text("1")
        assert not (tmp_path / "out").exists()
    assert (tmp_path / "out" / "a").read_text() == "1"
    with pytest.raises(ConfigError, match="in the way"), whole_folder(tmp_path / "out") as folder:
        (folder / "b").write_text("2")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [MARKER, "a"]
    with whole_folder(tmp_path / "out", overwrite=True) as folder:
        (folder / "b").write_text("2")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [MARKER, "b"]
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_failure_leaves_the_old_folder_and_nothing_else(tmp_path):
    with whole_folder(tmp_path / "out") as folder:
        (folder / "a").write_text("old")
    with pytest.raises(KeyboardInterrupt), whole_folder(tmp_path / "out", overwrite=True) as folder:
        (folder / "a").write_text("half")
        raise KeyboardInterrupt
    assert (tmp_path / "out" / "a").read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_place_that_cannot_be_written_is_an_error_for_people(tmp_path):
    (tmp_path / "file").write_text("")
    for manager in (whole_file, whole_folder):
        with pytest.raises(ConfigError, match="cannot be written"), manager(tmp_path / "file" / "a"):
            pass


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_an_error_for_people(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(ConfigError, match="may write to"), whole_file(tmp_path / "a"):
        pass


numbers = st.floats(allow_nan=False) | st.integers(-(2**62), 2**62)
# PyYAML folds the control character "next line" and the separators of lines and paragraphs into spaces: not for names
texts = st.text(st.characters(exclude_categories=("Cc", "Cs", "Zl", "Zp")), max_size=20)
values = st.recursive(
    st.none() | st.booleans() | numbers | texts,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(texts, inner, max_size=4),
    max_leaves=12,
)


@given(st.dictionaries(texts, values, max_size=4))
def test_yaml_keeps_every_value_and_every_bit(data):
    assert yaml.safe_load(dump_yaml(data)) == data


@given(st.lists(st.floats(allow_nan=False), min_size=1))
def test_yaml_keeps_every_bit_of_an_array(column):
    back = yaml.safe_load(dump_yaml({"a": np.array([column, column])}))["a"]
    assert np.array_equal(np.array(back, float), np.array([column, column]))


def test_yaml_of_nan_and_infinity():
    back = yaml.safe_load(dump_yaml({"a": [math.nan, math.inf, -math.inf]}))["a"]
    assert math.isnan(back[0]) and back[1:] == [math.inf, -math.inf]


def test_matrices_are_written_a_row_a_line_at_most():
    text = dump_yaml({"T": np.eye(4), "names": ["a", "b"]})
    assert text.splitlines()[0].startswith("T: [[1.0,")
    assert text.splitlines()[-2:] == ["- a", "- b"]


def test_plain_turns_numpy_and_paths_into_yaml_types(tmp_path):
    out = plain({"a": np.float64(1.5), "b": (np.int64(2), tmp_path), 3: np.bool_(True)})
    assert out == {"a": 1.5, "b": [2, str(tmp_path)], "3": True}
    assert type(out["a"]) is float and type(out["b"][0]) is int and type(out["3"]) is bool


@pytest.mark.parametrize(
    ("content", "needle"),
    [
        (b"a: [1, 2", "not valid YAML.*line 1"),
        (b"- 1\n- 2\n", "holds list, a mapping is needed"),
        (b"", "holds nothing"),
        (b"\xff\xfe\x00", "cannot be read as text"),
        (b"a: !!python/object/apply:os.getcwd []", "line 1: tag .* plain YAML is needed"),
    ],
)
def test_what_is_no_mapping_is_an_error_that_names_the_file(tmp_path, content, needle):
    (tmp_path / "a.yaml").write_bytes(content)
    with pytest.raises(ConfigError, match=f"a.yaml: {needle}"):
        load_yaml(tmp_path / "a.yaml")


def test_a_missing_file_is_an_error_that_names_it(tmp_path):
    with pytest.raises(ConfigError, match=r"none.yaml: no such file"):
        load_yaml(tmp_path / "none.yaml")

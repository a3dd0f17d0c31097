"""Readers of foreign files, by thousands of damaged files: what is wrong is an error for people, whatever it is.

`scripts/fuzz.py` does the same with 10^5 and more for each; the inputs that were once a fault are in fuzz_seeds.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

SCRIPTS = Path(__file__).parents[2] / "scripts"
sys.path.insert(0, str(SCRIPTS))

import fuzz  # noqa: E402
import fuzz_parsers  # noqa: E402

from rgbd_calib.errors import ConfigError  # noqa: E402
from rgbd_calib.io.images import decode_image  # noqa: E402
from rgbd_calib.io.schema_base import check_name  # noqa: E402
from rgbd_calib.io.tables import number  # noqa: E402

SEEDS = sorted((Path(__file__).parents[1] / "builders" / "fuzz_seeds").iterdir())
LINE = Path("table.csv"), 2


@pytest.fixture(scope="module")
def parsers(tmp_path_factory):
    return fuzz_parsers.parsers(tmp_path_factory.mktemp("fuzz"))


def test_every_parser_is_fuzzed(parsers):
    assert set(parsers) == set(fuzz.BY_BYTES) | set(fuzz.BY_STRUCTURE)


@pytest.mark.parametrize("name", [*fuzz.BY_BYTES, *fuzz.BY_STRUCTURE])
def test_what_is_whole_is_accepted(parsers, name):
    for data in parsers[name].seeds:
        assert fuzz_parsers.attempt(parsers[name], data) == fuzz_parsers.Outcome("accepted")


@pytest.mark.parametrize("path", SEEDS, ids=lambda path: path.name)
def test_what_was_once_a_fault_is_none_any_more(parsers, path):
    parser = next(p for p in parsers.values() if path.name.startswith(fuzz.slug(p.name) + "-"))
    assert fuzz_parsers.attempt(parser, path.read_bytes()).status != "fault"


@pytest.mark.parametrize("name", fuzz.BY_STRUCTURE)
def test_damage_by_structure(parsers, name):
    @settings(max_examples=2, suppress_health_check=list(HealthCheck))  # of 100 inputs each
    @given(fuzz.damaged(parsers[name]))
    def try_all(inputs):
        for data in inputs:
            outcome = fuzz_parsers.attempt(parsers[name], data)
            assert outcome.status != "fault", (outcome.what, data)

    try_all()


@pytest.mark.parametrize("name", fuzz.BY_BYTES)
@settings(max_examples=60, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_damage_by_bytes(parsers, name, data):
    whole = data.draw(st.sampled_from(parsers[name].seeds))
    changed = bytearray(whole[: data.draw(st.integers(0, len(whole)) | st.just(len(whole)))])
    for at, value in data.draw(st.lists(st.tuples(st.integers(0, len(whole)), st.integers(0, 255)), max_size=4)):
        if at < len(changed):
            changed[at] = value
    mended = fuzz.with_checksums(bytes(changed))
    for damaged in (bytes(changed), mended):
        outcome = fuzz_parsers.attempt(parsers[name], damaged)
        assert outcome.status != "fault", (outcome.what, damaged)


@given(st.binary(max_size=200), st.sampled_from((b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0", b"\xff\xd8\xff\xe1")))
def test_bytes_that_are_no_image(rest, start):
    with pytest.raises(ConfigError, match="damaged or no image"):
        decode_image(start + rest, "a.png")


@given(
    st.text(max_size=12)
    | st.sampled_from((".", "..", "a/b", "/a", "a\\b", "C:", "C:x", "a\x00", "", " a", "C1", "Ä ö"))
)
def test_a_camera_name_that_passes_is_a_folder_of_the_recording(text):
    try:
        check_name(text)
    except ValueError:
        return
    folder = Path("/recording")
    assert (folder / text).parent == folder and Path(text).name == text and text.isprintable()


@given(st.floats(-1e6, 1e6))
def test_numbers_come_back_bit_by_bit(value):
    assert math.copysign(1, value) == math.copysign(1, number(*LINE, "u_px", repr(value)))
    assert number(*LINE, "u_px", repr(value)) == value


@given(st.text(max_size=8) | st.sampled_from(("nan", "inf", "-Infinity", "1e999", "1_0", "１", "0x1", "1,0", "")))
def test_what_is_no_number_names_its_line(text):
    try:
        assert np.isfinite(number(*LINE, "u_px", text)) and text.isascii() and "_" not in text
    except ConfigError as error:
        assert "table.csv: line 2: u_px: " in str(error) and "\n" not in str(error)

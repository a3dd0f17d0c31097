"""The expected error while a recording grows: it falls, ends the capture, and what is wrong is named at the rig."""

from __future__ import annotations

import json
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from small_recording import draw_recording
from virtual_rig import VirtualRig, interrupted, last_session

from rgbd_calib.capture.expected_error import ErrorCourse, ExpectedError
from rgbd_calib.views.coverage import Coverage

COVERED = Coverage({}, {}, (), "", True, True)
BOARD = ("--board", "9x6", "--square", "0.06")
TIMEOUT_S = 90.0
FRAMES = 13
"""A prime: a replay that is sampled at any interval shows all of them."""


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return draw_recording(tmp_path_factory.mktemp("drawn") / "recording", cameras=2, frames=FRAMES)


class Told:
    """An estimate with what it tells; `expected` is to be used as a context manager."""

    def __init__(self, recording: Path, until_mm: float, cameras: tuple[str, ...] = ("C1", "C2")) -> None:
        self.shown: list[ErrorCourse] = []
        self.warned: list[str] = []
        self.logged: list[str] = []
        tell = {"show": self.shown.append, "warn": self.warned.append, "log": self.logged.append}
        self.expected = ExpectedError(recording, until_mm, cameras, **tell)


class Ran:
    """A run of calibrate that has ended."""

    def __init__(self, status: int) -> None:
        self.status = status

    def poll(self) -> int:
        return self.status

    def terminate(self) -> None:
        pass

    def wait(self, timeout: float) -> int:
        return self.status


@pytest.fixture
def results(monkeypatch) -> list[float | str | dict]:
    """What runs of calibrate give, one after the other, the last again and again: an expected error in mm, or why there is none;
    or what is measured of a rig without depth."""
    given: list[float | str | dict] = []

    def start(self: ExpectedError) -> Ran:
        own = given.pop(0) if len(given) > 1 else given[0]
        (self._folder / "messages").write_text(f"Warning: slow\nError: {own}\n")
        distrust = isinstance(own, float) and own < 0
        numbers = {
            "verdict": "untrusted" if distrust else "good",
            "headline": "Do not trust this. C2 moved." if distrust else "Good.",
            "next_steps": ["Fix it."],
            "film": ["The weakest pair is C1 - C2.", "C1's k1: film the corners."],
            "expected": {"mean_mm": abs(own)} if isinstance(own, float) else None,
            "measured": {"all": {"points": 0, **own}} if isinstance(own, dict) else None,
            "cameras": {"C1": {}, "C2": {}},
        }
        (self._folder / "numbers.json").write_text(json.dumps(numbers))
        return Ran(1 if isinstance(own, str) else 0)

    monkeypatch.setattr(ExpectedError, "_start", start)
    return given


def courses(told: Told, n: int, coverage: Coverage = COVERED) -> Iterator[ErrorCourse]:
    """After each of `n` runs."""
    with told.expected as expected:
        expected.update(0, coverage)
        for k in range(n):
            expected.update(3 * (k + 1), coverage)
            yield expected.course


def _first_frames(source: Path, target: Path, n: int) -> None:
    """Put the first frames of a recording into another."""
    for path in sorted(source.rglob("0*.png")):
        if int(path.stem) < n:
            here = target / path.relative_to(source)
            here.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, here)
    shutil.copy(source / "dataset.yaml", target)


def _wait_for_estimate(told: Told, frame_sets: int) -> None:
    n, deadline = len(told.shown), time.monotonic() + TIMEOUT_S
    while len(told.shown) == n and time.monotonic() < deadline:
        told.expected.update(frame_sets, COVERED)
        time.sleep(0.05)


def _running(path: Path) -> list[str]:
    """Processes that name a path."""
    found = []
    for line in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):  # it has ended meanwhile
            found.append(line.read_bytes().replace(b"\0", b" ").decode(errors="replace"))
    return [line for line in found if str(path) in line]


def test_the_error_of_a_growing_recording_falls_until_it_is_reached(drawn, tmp_path):
    grows = tmp_path / "grows"
    told = Told(grows, 0.3)
    _first_frames(drawn, grows, 4)
    before = sorted(grows.rglob("*"))
    with told.expected:
        _wait_for_estimate(told, 4)
        assert sorted(grows.rglob("*")) == before  # nothing is added to the recording
        assert not told.expected.course.reached, told.expected.course
        _first_frames(drawn, grows, FRAMES)
        told.expected.update(FRAMES, COVERED)
        _wait_for_estimate(told, FRAMES)
        temporary = told.expected._folder
        told.expected.update(2 * FRAMES, COVERED)  # begins once more
        assert _running(grows)
    assert not _running(grows) and not temporary.exists()
    few, all_of_them = told.expected.course.estimates_mm
    assert all_of_them < few / 1.3  # of 4 and 13 frames: a factor of 1.8 by their number
    assert told.expected.course.reached and not told.warned
    assert told.logged == [
        f"expected error {mm:.2f} mm after {n} frame sets of this session"
        for mm, n in ((few, 4), (all_of_them, FRAMES))
    ]


def test_a_capture_ends_when_the_error_is_reached(drawn, run, tmp_path, results):
    out = tmp_path / "out"
    results += [4.13, 2.21, 0.49]
    quick = ("--settle", "0.1", "--interval", "0.1", "--count", "200")
    ended = run("capture", out, "--driver", f"replay:{drawn}", *BOARD, *quick, "--until-mm", "0.5")
    assert ended.status == 0, ended.stderr
    assert "expected error: 4.1 → 2.2 mm, until 0.5\n" in ended.stderr
    last = ended.stderr.splitlines()
    assert re.fullmatch(r"Expected error: .* → 0\.49 mm, until 0\.5: reached", last[-2])
    assert last[-1] == f"Next: rgbd-calib calibrate {out} -o rig.yaml"
    assert "wall with --depth-bias" in last[-3] and "Still missing" not in ended.stderr
    session = last_session(out)
    assert 8 <= session["counts"]["frame_sets"] < 200  # 8 shared views of each camera, whatever the error
    said = [e["event"] for e in session["events"] if "expected error" in e["event"]]
    assert said[0].startswith("expected error 4.1 mm after ") and said[-1].startswith("expected error 0.49 mm after ")
    assert not list(out.glob("*rig*"))


def test_a_wrong_square_is_named_while_filming_and_nothing_outlives_ctrl_c(drawn, tmp_path):
    out, rig = tmp_path / "out", VirtualRig(tmp_path, tmp_path)
    options = ("--board", "9x6", "--square", "0.05", "--settle", "0.1", "--interval", "0.3", "--until-mm", "0.5")
    process = rig.start("capture", out, "--driver", f"replay:{drawn}", *options)
    try:
        rig.wait_for_text(out / "capture.yaml", "C1, C2: measured depth")
        ended = interrupted(process)
    finally:
        rig.close()
    assert ended.status == 0 and not _running(out)
    assert "expected error: none yet: C1, C2: measured depth over the board's distance" in ended.stderr
    assert last_session(out)["status"] == "interrupted"


def test_what_keeps_the_error_from_falling_is_named_once(tmp_path, results):
    results += [2.0, 1.01, 1.005, 1.0, 0.99]
    told = Told(tmp_path, 0.5)
    assert [len(told.warned) for _ in courses(told, 5)] == [0, 0, 0, 1, 1]
    assert told.expected.course.history == "2.0 → 1.0 → 1.0 → 1.0 → 0.99 mm" and not told.expected.course.reached
    assert told.warned[0].endswith("(2.0 → 1.0 → 1.0 → 1.0 mm). It is limited: C1's k1: film the corners")
    missing = Told(tmp_path, 0.5)
    assert list(courses(missing, 3, replace(COVERED, missing=("C1: tilt",))))[-1].no_longer_falls and not missing.warned


def test_a_refusal_is_a_warning_when_more_frame_sets_did_not_change_it(tmp_path, results):
    results += ["C1 and C2: 3 common views", "C1: depth is 1.21 times", "C1: depth is 1.25 times", 0.4]
    told = Told(tmp_path, 0.5)
    first, second, third, last = [(course.text, list(told.warned)) for course in courses(told, 4)]
    assert first == ("none yet: C1 and C2: 3 common views", [])
    assert second == ("none yet: C1: depth is 1.21 times", [])
    assert third == ("none yet: C1: depth is 1.25 times", ["C1: depth is 1.25 times"])
    assert last == ("0.40 mm, until 0.5", third[1]) and told.expected.course.reached


def test_without_depth_it_is_what_is_measured_at_the_board(tmp_path, results):
    results += [{}, {"median_px": 0.2, "median_board_mm": 0.7}, {"median_px": 0.1, "median_board_mm": 0.4}]
    first, second, third = courses(Told(tmp_path, 0.5), 3)
    assert first.text.startswith("none yet: two cameras that see the board together expected")
    assert second.text == "0.70 mm at the board, until 0.5" and not second.reached
    assert third.text == "0.70 → 0.40 mm at the board, until 0.5" and third.reached


def test_a_low_error_that_is_not_to_be_trusted_or_of_few_cameras_is_not_enough(tmp_path, results):
    results += [-0.3]
    told = Told(tmp_path, 0.5)
    *_, course = courses(told, 2)
    assert not course.reached and course.text == "0.30 → 0.30 mm, until 0.5. Do not trust this. C2 moved. Fix it."
    assert told.warned == ["Do not trust this. C2 moved. Fix it."]
    results[:] = [0.3]
    (reached,) = courses(Told(tmp_path, 0.5), 1)
    (one_place,) = courses(Told(tmp_path, 0.5), 1, replace(COVERED, shared_enough=False))
    assert reached.reached and not one_place.reached
    (three,) = courses(Told(tmp_path, 0.5, ("C1", "C2", "C3")), 1)
    assert not three.reached and three.text == "none yet: C3: no image yet"
    (apart,) = courses(Told(tmp_path, 0.5), 1, replace(COVERED, connected=False))
    assert apart.estimates_mm == ()

"""How large the rig's error is expected to be, estimated from what is on the disk while cameras still record.

`rgbd-calib calibrate` runs beside the recording, in a process of its own that yields to all others, with one thread; detections
are cached, so that a run looks at new images only. Its rig goes into a temporary folder: nothing is added to the recording.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import rgbd_calib
from rgbd_calib.views.coverage import Coverage

MIN_NEW = 3
"""Frame sets between two estimates at least; of a long recording a tenth: an error falls with the root of their number."""
NO_LONGER_FALLS = 0.97
"""Of the estimate two before: less than 3 % over three estimates."""
_SHOWN = 5
_NICENESS = 10
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_PATIENCE_S = 2.0
"""For a process that was asked to end."""


@dataclass(frozen=True)
class ErrorCourse:
    """The expected errors so far, and what is asked for."""

    until_mm: float
    estimates_mm: tuple[float, ...] = ()
    refusal: str = ""
    """Why the last run gave no estimate."""
    distrust: str = ""
    """Why the last estimate is not to be trusted, and what to do."""
    shared_enough: bool = False
    """The error is stated where cameras saw the board together: False while that is little of the volume."""
    film: tuple[str, ...] = ()
    """What the last estimate asks to film, the weakest pair of cameras first."""
    at_board: bool = False
    """Without depth: what is measured between cameras at the board, across the line of sight."""

    @property
    def reached(self) -> bool:
        """As asked for, to be trusted, and from shared views near and far."""
        low = bool(self.estimates_mm) and self.estimates_mm[-1] <= self.until_mm
        return low and self.shared_enough and not self.distrust and not self.refusal

    @property
    def no_longer_falls(self) -> bool:
        own = self.estimates_mm
        return len(own) >= 3 and own[-1] > NO_LONGER_FALLS * own[-3]

    @property
    def history(self) -> str:
        """Such as `4.1 → 2.2 → 1.3 mm`; empty before the first estimate."""
        shown = " → ".join(_mm(value) for value in self.estimates_mm[-_SHOWN:])
        return f"{shown} mm{' at the board' if self.at_board else ''}" if shown else ""

    @property
    def text(self) -> str:
        """The history and its goal, or why there is none."""
        why = self.distrust or self.refusal
        if not self.estimates_mm:
            return f"none yet: {why}" if why else f"too few frame sets yet, until {self.until_mm:g} mm"
        return f"{self.history}, until {self.until_mm:g}" + (f". {why}" if why else "")

    @property
    def limits(self) -> str:
        """What keeps the error from falling."""
        own = self.film[1:] or ("lens, depth and board are determined; more frame sets lower the error slowly",)
        return "; ".join(text.rstrip(".") for text in own)


class ExpectedError:
    """Estimates of a growing recording; use as a context manager, and call :meth:`update` again and again."""

    def __init__(
        self,
        recording: Path,
        until_mm: float,
        cameras: Collection[str],
        *,
        show: Callable[[ErrorCourse], None],
        warn: Callable[[str], None],
        log: Callable[[str], None],
    ) -> None:
        """`show` is given every new course, `warn` what the person at the rig must know, `log` each estimate."""
        self.course = ErrorCourse(until_mm)
        self._recording, self._cameras = recording.absolute(), frozenset(cameras)
        self._show, self._warn, self._log = show, warn, log
        self._process: subprocess.Popen[bytes] | None = None
        self._frame_sets = -MIN_NEW
        self._told: set[str] = set()

    def __enter__(self) -> ExpectedError:
        self._temporary = TemporaryDirectory(prefix="rgbd-calib-")
        self._folder = Path(self._temporary.name)
        self._show(self.course)
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            _end(self._process)
        self._temporary.cleanup()

    def update(self, frame_sets: int, coverage: Coverage) -> None:
        """Take what a run has found, and start the next one where `frame_sets` on the disk are enough; never waits."""
        if self._process is not None:
            status = self._process.poll()
            if status is None:
                return
            self._process = None
            self._take(status, coverage)
        new = frame_sets - self._frame_sets
        if coverage.connected and new >= max(MIN_NEW, frame_sets // 10):
            self._frame_sets = frame_sets
            self._process = self._start()

    def _start(self) -> subprocess.Popen[bytes]:
        arguments = ["calibrate", str(self._recording), "-o", str(self._folder / "rig.yaml"), "--overwrite"]
        with (self._folder / "numbers.json").open("wb") as out, (self._folder / "messages").open("wb") as messages:
            process = subprocess.Popen(
                [sys.executable, "-m", "rgbd_calib", *arguments, "--json", "--quiet", "--jobs", "1"],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=messages,
                cwd=Path(rgbd_calib.__file__).parents[1],  # this program, whatever the user's folder holds
                env={**os.environ, **dict.fromkeys(_THREADS, "1")},
                start_new_session=True,  # Ctrl-C is for the recording, which then ends this process
            )
        with suppress(OSError, AttributeError):
            os.setpriority(os.PRIO_PROCESS, process.pid, _NICENESS)
        return process

    def _take(self, status: int, coverage: Coverage) -> None:
        if status != 0:
            return self._refused(_last_error(self._folder / "messages", status))
        numbers = json.loads((self._folder / "numbers.json").read_text(encoding="utf-8"))
        if absent := sorted(self._cameras - set(numbers["cameras"])):
            return self._refused(f"{', '.join(absent)}: no image yet")
        expected, measured = numbers["expected"], numbers["measured"]
        if expected is not None:
            found_mm = expected["mean_mm"]
        else:
            found_mm = measured["all"].get("median_board_mm") if measured is not None else None
        if found_mm is None:
            return self._refused(
                "two cameras that see the board together expected, fewer found: no error in mm is known"
            )
        mm = float(found_mm)
        untrusted = numbers["verdict"] == "untrusted"
        distrust = " ".join([numbers["headline"], *numbers["next_steps"][:1]]) if untrusted else ""
        self.course = replace(
            self.course,
            estimates_mm=(*self.course.estimates_mm, mm),
            refusal="",
            distrust=distrust,
            shared_enough=coverage.shared_enough,
            film=tuple(numbers["film"]),
            at_board=expected is None,
        )
        self._show(self.course)
        self._log(f"expected error {_mm(mm)} mm after {self._frame_sets} frame sets of this session")
        if distrust:
            self._warn_once(distrust)
        elif coverage.enough and self.course.no_longer_falls and not self.course.reached:
            self._warn_once(
                f"the expected error no longer falls ({self.course.history}). It is limited: {self.course.limits}"
            )

    def _refused(self, why: str) -> None:
        """The first time it may be for want of frame sets; what more of them did not change is a warning."""
        again = _without_numbers(why) == _without_numbers(self.course.refusal)
        self.course = replace(self.course, refusal=why)
        self._show(self.course)
        if again:
            self._warn_once(why)

    def _warn_once(self, text: str) -> None:
        if _without_numbers(text) not in self._told:
            self._told.add(_without_numbers(text))
            self._warn(text)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _last_error(messages: Path, status: int) -> str:
    lines = messages.read_text(encoding="utf-8", errors="replace").split("\n")
    errors = [line.removeprefix("Error: ") for line in lines if line.startswith("Error: ")]
    return errors[-1] if errors else f"calibrate ended with status {status}"


def _mm(value: float) -> str:
    return f"{value:.1f}" if value >= 1 else f"{value:.2f}"


def _without_numbers(text: str) -> str:
    return re.sub(r"[\d.]+(?: → [\d.]+)*", "", text)

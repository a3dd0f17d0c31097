"""A rig watched over days: the same comparison with one old snapshot, round after round.

Nothing grows from round to round: the old snapshot's surfaces are made once, each round's are dropped. A round that fails
(a camera in use, a file half written) is reported, and the next one follows.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timezone
from math import degrees
from pathlib import Path
from typing import Any

from rgbd_calib.errors import CalibrationError, ConfigError, RgbdCalibError
from rgbd_calib.io.recording import open_recording
from rgbd_calib.io.snapshot import newest_frames, read_snapshot
from rgbd_calib.pipeline.snapshot import compare_with, summary
from rgbd_calib.trust.snapshot import Before, SnapshotParams, judge_motions
from rgbd_calib.trust.snapshot.rig import RigVerdict
from rgbd_calib.types import CameraSnapshot, Rig

_FIRST = b"# HELP rgbd_calib_monitor_"
SnapshotSource = Callable[[], Mapping[str, CameraSnapshot] | None]
"""New snapshots by camera; None where there is nothing new since the last call."""


@dataclass(frozen=True)
class MonitorParams:
    every_s: float = 60.0
    confirm: int = 3
    """Rounds in a row that must find a camera moved before it counts as drift: people pass."""
    rounds: int | None = None
    """None: until stopped."""
    snapshot: SnapshotParams = field(default_factory=SnapshotParams)


@dataclass(frozen=True)
class MonitorRound:
    """One comparison."""

    number: int
    time: str
    """UTC, ISO 8601."""
    verdict: RigVerdict | None
    """None where there was none."""
    problem: str
    """Why there was none."""
    drift: bool
    """A camera moved, in so many rounds in a row."""
    seconds: float

    @property
    def status(self) -> str:
        """holds, moved, undetermined, or failed."""
        if self.verdict is None:
            return "failed"
        return "holds" if self.verdict.holds else "moved" if self.verdict.moved else "undetermined"

    def line(self) -> dict[str, Any]:
        """What a line of JSON has; without covariances and pairs."""
        out: dict[str, Any] = {
            "time": self.time, "round": self.number, "status": self.status, "drift": self.drift, "seconds": round(self.seconds, 3)
        }  # fmt: skip
        if self.verdict is None:
            return out | {"problem": self.problem}
        numbers = summary(self.verdict)
        kept = {key: numbers[key] for key in ("verdict", "moved", "undetermined", "not_checked", "rig_motion")}
        cameras = {
            name: {key: value for key, value in own.items() if key != "covariance"}
            for name, own in numbers["cameras"].items()
        }
        return out | kept | {"cameras": cameras}


class FolderSource:
    """The newest frames of a recording that another program fills."""

    def __init__(self, path: Path, cameras: tuple[str, ...], frames: int) -> None:
        self._path, self._cameras, self._frames = path, cameras, frames
        self._seen: Any = None

    def __call__(self) -> Mapping[str, CameraSnapshot] | None:
        recording = open_recording(self._path)
        recording = newest_frames(recording, self._frames)
        stamps = [
            (str(path), path.stat().st_mtime_ns)
            for files in (recording.color_files, recording.depth_files)
            for own in files.values()
            for path in own.values()
        ]
        if stamps == self._seen:
            return None
        self._seen = stamps
        found = {name: read_snapshot(recording, name) for name in self._cameras if name in recording.cameras}
        return {name: snapshot for name, snapshot in found.items() if snapshot is not None}


def watch(
    rig: Rig,
    before: Mapping[str, Before],
    source: SnapshotSource,
    params: MonitorParams,
    pause: Callable[[float], bool],
) -> Iterator[MonitorRound]:
    """Rounds until `params.rounds`, or until `pause` (seconds) says that it is to stop."""
    in_a_row, number = 0, 0
    while params.rounds is None or number < params.rounds:
        number += 1
        begin = time.monotonic()
        verdict, problem = _round(rig, before, source, params)
        in_a_row = in_a_row if verdict is None else in_a_row + 1 if verdict.moved else 0
        now = datetime.now(timezone.utc).isoformat(timespec="seconds")
        seconds = time.monotonic() - begin
        yield MonitorRound(number, now, verdict, problem, in_a_row >= params.confirm, seconds)
        last = params.rounds is not None and number >= params.rounds
        if last or pause(max(params.every_s - (time.monotonic() - begin), 0.0)):
            return


def _round(
    rig: Rig, before: Mapping[str, Before], source: SnapshotSource, params: MonitorParams
) -> tuple[RigVerdict | None, str]:
    try:
        taken = source()
        if taken is None:
            return None, "no new images since the last round"
        both = [name for name in before if name in taken]
        if not both:
            raise CalibrationError(f"none of the cameras {', '.join(before)} has new colour and depth images")
        found = compare_with(before, both, taken.get)
        return judge_motions(rig, found, params.snapshot), ""
    except (RgbdCalibError, OSError) as error:
        return None, str(error)


def refuse_foreign(path: Path) -> None:
    """Raise ConfigError where a file is there that is no earlier state of a monitor."""
    if path.is_file() and path.stat().st_size:
        with path.open("rb") as stream:
            if stream.read(len(_FIRST)) != _FIRST:
                raise ConfigError(
                    f"{path}: metrics of a monitor, or no file yet, expected; something else found. Choose another file"
                )


def metrics(round_: MonitorRound, failures: int) -> str:
    """The state in Prometheus' text format, for a textfile collector."""
    lines = [
        *_metric("rgbd_calib_monitor_rounds_total", "counter", "Rounds since the start.", [("", round_.number)]),
        *_metric("rgbd_calib_monitor_failures_total", "counter", "Rounds without a comparison.", [("", failures)]),
        *_metric("rgbd_calib_monitor_drift", "gauge", "1 where a camera moved.", [("", int(round_.drift))]),
        *_metric("rgbd_calib_monitor_seconds", "gauge", "Duration of the last round.", [("", round_.seconds)]),
        *_metric(
            "rgbd_calib_monitor_timestamp_seconds", "gauge", "Time of the last round.",
            [("", datetime.fromisoformat(round_.time).timestamp())],
        ),
    ]  # fmt: skip
    if round_.verdict is not None:
        lines += _metric("rgbd_calib_rig_holds", "gauge", "1 where no camera moved.", [("", int(round_.verdict.holds))])
        cameras = {f'{{camera="{_escaped(name)}"}}': own for name, own in round_.verdict.cameras.items()}
        for name, text, values in (
            (
                "displacement_metres",
                "Displacement at the working distance.",
                [c.displacement_m for c in cameras.values()],
            ),
            ("displacement_sd_metres", "Its standard deviation.", [c.displacement_sd_m for c in cameras.values()]),
            ("rotation_degrees", "Rotation.", [degrees(c.turn_rad) for c in cameras.values()]),
            (
                "unchanged_ratio",
                "Share of the scene that is unchanged.",
                [c.motion.unchanged_share for c in cameras.values()],
            ),
            ("moved", "1 where the camera moved against the others.", [float(c.moved) for c in cameras.values()]),
        ):
            labelled = list(zip(cameras, values, strict=True))
            lines += _metric(f"rgbd_calib_camera_{name}", "gauge", text, labelled)
    return "\n".join(lines) + "\n"


def _metric(name: str, kind: str, text: str, values: list[tuple[str, float]]) -> list[str]:
    if not values:
        return []
    return [
        f"# HELP {name} {text}",
        f"# TYPE {name} {kind}",
        *(f"{name}{label} {value:.15g}" for label, value in values),
    ]


def _escaped(label: str) -> str:
    return label.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")

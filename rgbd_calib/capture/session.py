"""A capture from start to end: cameras on, record, cameras off, and a log that says what happened."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from rich.console import Console

from rgbd_calib.capture.board_watch import BoardFinder
from rgbd_calib.capture.expected_error import ErrorCourse, ExpectedError
from rgbd_calib.capture.guide import Guide
from rgbd_calib.capture.modes import ModeParams, record_depth_bias, record_intrinsics, record_rig
from rgbd_calib.capture.shots import DepthParams, Photographer
from rgbd_calib.capture.signals import stopping_on_signals
from rgbd_calib.capture.studio import Stopped, Studio, Tally
from rgbd_calib.capture.terminal import LiveGuidance, PlainGuidance, guidance
from rgbd_calib.capture.wave import PENDING_PAIRS, record_wave
from rgbd_calib.errors import CalibrationError, ConfigError, RgbdCalibError
from rgbd_calib.io.capture_log import CaptureLog, Status
from rgbd_calib.io.growing_recording import GrowingRecording
from rgbd_calib.io.recording import open_recording
from rgbd_calib.sensors.discover import find_cameras
from rgbd_calib.sensors.driver import Drivers, load_drivers
from rgbd_calib.sensors.reader import KEEP_EVERY_PAIR, KEEP_PAIRS
from rgbd_calib.sensors.rig import SensorRig
from rgbd_calib.sensors.writer import MAX_PENDING, FrameSetWriter
from rgbd_calib.types import Board
from rgbd_calib.views.coverage import CoverageParams

Ask = Callable[[str, float | None], float | None]
"""Asks for the next distance of a depth-bias recording; see :func:`record_depth_bias`."""


@dataclass(frozen=True)
class CaptureParams:
    """All that can be asked of a capture."""

    out: Path
    kind: Literal["rig", "intrinsic", "depth-bias", "wave"] = "rig"
    mode: ModeParams = field(default_factory=ModeParams)
    depth: DepthParams = field(default_factory=DepthParams)
    coverage: CoverageParams = field(default_factory=CoverageParams)
    board: Board | None = None
    devices: dict[str, str] = field(default_factory=dict)
    """{camera id: serial number, USB path or uri}; empty: all that are attached."""
    distances_m: tuple[float, ...] = ()
    wave_s: float = 0.0
    """Seconds of a carried board, of kind `wave`."""
    drivers: tuple[str, ...] = ()
    """See :func:`load_drivers`; empty: all that are installed."""
    redist: Path | None = None
    append: bool = False
    auto_exposure: bool = False
    allow_unregistered: bool = False
    sync_leader: str | None = None
    """The camera that gives the pulse of a synchronisation cable."""
    settle_s: float = 2.0
    give_up_s: float = 15.0
    preview: tuple[str, int] | None = None
    """(host, port) of the web page."""
    until_mm: float | None = None
    """Expected error at which a recording of a rig ends; None: it is not estimated."""
    color_only: bool = False
    """Depth is left out."""


@dataclass(frozen=True)
class CaptureResult:
    """How it ended."""

    status: Status
    frame_sets: int
    tally: Tally
    lost: dict[str, dict[str, int]]
    """{camera: {stream: frames that never came}}."""
    events: int
    missing: tuple[str, ...]
    error: ErrorCourse | None
    board_m: dict[str, tuple[float, float]]
    """{camera with depth: nearest and farthest board}; empty where no board was named."""


def capture(params: CaptureParams, console: Console, ask: Ask) -> CaptureResult:
    """Record until it is enough, until the user stops it, or until it cannot go on.

    Raises
    ------
    RgbdCalibError
        No runtime, no camera, no board to wait for, a camera that cannot do what is needed, a full disk, cameras that all fell silent, or
        not one frame set. What was recorded before is whole, and capture.yaml says what happened.
    """
    cv2.setNumThreads(1)  # the cameras' readers need the other cores
    recording = GrowingRecording(
        params.out,
        params.board,
        registered=not params.allow_unregistered,
        append=params.append,
        synchronous=params.kind != "wave",
    )
    if recording.board is None and (params.mode.on_still or params.mode.until_enough or params.until_mm is not None):
        raise ConfigError(
            f"{params.out}: no board is named there; --on-still, --until-enough, --until-mm and --intrinsic look for one. "
            "Add --board 9x6 --square 0.06"
        )
    stop = threading.Event()
    with stopping_on_signals(stop):
        runtime = load_drivers(params.drivers, params.redist)
        try:
            return _Session(params, recording, runtime, stop).run(console, ask)
        finally:
            runtime.close()


class _Session:
    """The parts of one capture, and the order in which they start and end."""

    def __init__(
        self, params: CaptureParams, recording: GrowingRecording, runtime: Drivers, stop: threading.Event
    ) -> None:
        self._params = params
        self._recording = recording
        self._runtime = runtime
        self._stop = stop
        self._found = find_cameras(runtime)
        self._log = CaptureLog(params.out, " ".join(sys.argv), f"rgbd-calib {version('rgbd-calib')}")
        self._cameras = self._found.assign(params.devices, self._log.identities())
        if params.sync_leader is not None and params.sync_leader not in self._cameras:
            raise ConfigError(f"--sync {params.sync_leader}: one of the cameras {', '.join(self._cameras)} needed")
        recording.identify({camera: identity.serial for camera, identity in self._cameras.items()})
        self._guide = Guide(tuple(self._cameras), recording.board, params.coverage)
        self._tally = Tally()
        self._started_s = time.monotonic()
        self._events = 0
        self._display: PlainGuidance | LiveGuidance | None = None

    def run(self, console: Console, ask: Ask) -> CaptureResult:
        params = self._params
        rig = SensorRig(
            self._runtime,
            self._cameras,
            self._note,
            settle_s=params.settle_s,
            lock_exposure=not params.auto_exposure,
            keep_depth=max(2, params.depth.frames + 4),
            keep_pairs=KEEP_EVERY_PAIR if params.kind == "wave" else KEEP_PAIRS,
            allow_unregistered=params.allow_unregistered,
            color_only=params.color_only,
            sync_leader=params.sync_leader,
        )
        status: Status = "complete"
        message: str | None = None
        failure: RgbdCalibError | None = None
        with guidance(console, live=params.kind != "depth-bias") as self._display:
            self._log.set()
            for warning in self._found.warnings:
                self._note("", warning)
            try:
                with rig:
                    self._record(rig, ask)
            except (Stopped, KeyboardInterrupt):
                status, message = "interrupted", "stopped by the user"
            except RgbdCalibError as error:
                status, message, failure = "failed", str(error), error
        with suppress(RgbdCalibError):  # the disk may be full
            self._log.end(status, message, self._counts(rig))
        if failure is not None:
            raise failure
        if self._recording.finished == 0 and status != "complete":
            raise CalibrationError(f"{params.out}: {message} before the first frame set; nothing was recorded")
        state = self._guide.state()
        coverage = state.coverage
        lost = {camera: {str(kind): n for kind, n in counts.lost.items()} for camera, counts in rig.counts().items()}
        missing = coverage.missing if coverage else ()
        with_depth = [camera for camera, info in self._recording.cameras.items() if info.depth_stated]
        seen = {c: own for c, own in (coverage.cameras if coverage else {}).items() if c in with_depth and own.views}
        board_m = {c: (own.nearest_m, own.farthest_m) for c, own in seen.items()}
        return CaptureResult(
            status, self._recording.finished, self._tally, lost, self._events, missing, state.error, board_m
        )

    def _record(self, rig: SensorRig, ask: Ask) -> None:
        params = self._params
        self._log.set(cameras={c: asdict(device) | exposure for c, (device, exposure) in rig.settings().items()})
        self._recording.describe(rig.describe())
        clock_zero_s = time.monotonic() - (time.time() - self._log.clock_zero_unix_s)
        photographer = Photographer(rig, params.depth, clock_zero_s)
        with ExitStack() as stack:
            board = self._recording.board
            finder = stack.enter_context(BoardFinder(board)) if board else None
            pending = PENDING_PAIRS * len(rig.cameras) if params.kind == "wave" else MAX_PENDING
            writer = stack.enter_context(FrameSetWriter(self._recording, pending))
            if finder and params.append:
                self._remember_earlier(finder)
            if self._display is not None:
                self._guide.listen(self._display.update)
            if params.preview is not None:
                from rgbd_calib.capture.preview import preview_server  # a web server takes long to import

                server = stack.enter_context(preview_server(self._guide, rig, *params.preview))
                if self._display is not None:
                    self._display.note("", f"preview: {server.url}")  # not for the log: the address is a secret
            studio = Studio(
                rig, photographer, writer, self._guide, finder, self._stop, params.give_up_s, self._note, self._tally
            )
            if params.until_mm is not None:
                expected = ExpectedError(
                    params.out,
                    params.until_mm,
                    self._cameras,
                    show=self._guide.estimated,
                    warn=lambda text: self._note("", text),
                    log=lambda text: self._log_event("", text),
                )
                studio.expected = stack.enter_context(expected)
            try:
                if params.kind == "intrinsic":
                    record_intrinsics(studio, params.mode, params.coverage)
                elif params.kind == "depth-bias":
                    record_depth_bias(studio, params.mode, params.distances_m, ask)
                elif params.kind == "wave":
                    record_wave(studio, params.wave_s)
                else:
                    record_rig(studio, params.mode)
            finally:
                writer.flush()

    def _note(self, camera: str, text: str) -> None:
        """Tell the user and the log of something; called from several threads."""
        self._events += 1
        if self._display is not None:
            self._display.note(camera, text)
        self._guide.event(f"{camera}: {text}" if camera else text)
        self._log_event(camera, text)

    def _log_event(self, camera: str, text: str) -> None:
        with suppress(RgbdCalibError):  # a full disk is the writers' to tell
            self._log.event(camera, text, time.monotonic() - self._started_s)

    def _remember_earlier(self, finder: BoardFinder) -> None:
        """Coverage starts with what earlier sessions recorded."""
        if not (self._params.out / "dataset.yaml").exists():
            return
        recording = open_recording(self._params.out)
        for frame in recording.frames:
            cameras = [c for c in recording.cameras if frame in recording.color_files[c]]
            pictures = {c: np.ascontiguousarray(recording.color(c, frame)[..., ::-1]) for c in cameras}
            self._guide.known(frame, finder.find(pictures), {c: p.shape[1::-1] for c, p in pictures.items()})

    def _counts(self, rig: SensorRig) -> dict[str, Any]:
        spreads_ms = self._tally.spreads_ms or [math.nan]
        return {
            "frame_sets": self._recording.finished,
            "incomplete_frame_sets": self._tally.incomplete,
            "absent": self._tally.absent,
            "dropped_because_moved": self._tally.moved,
            "not_written": self._tally.not_written,
            "spread_ms": {"median": float(np.median(spreads_ms)), "max": float(np.max(spreads_ms))},
            "cameras": {camera: asdict(counts) for camera, counts in rig.counts().items()},
        }

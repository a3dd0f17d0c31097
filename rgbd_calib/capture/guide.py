"""What the person at the board should know now; written by the recording thread, read by terminal and web page."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from rgbd_calib.capture.board_watch import DetectedFrameSet, board_views
from rgbd_calib.capture.expected_error import ErrorCourse
from rgbd_calib.capture.stillness import Corners
from rgbd_calib.types import Board
from rgbd_calib.views.coverage import Coverage, CoverageParams, ViewCoverage, place_view, summarize_coverage
from rgbd_calib.views.range_coverage import RangeCoverage, range_coverage

_LOOKS = 3
"""Kept, so that a page that asks for the state and then for its pictures gets those of the same look."""


@dataclass(frozen=True)
class CameraNow:
    """One camera at this moment."""

    live: bool
    sees_board: bool
    corners_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    """(n, 2) in the picture that was looked at last."""


@dataclass(frozen=True)
class GuideState:
    """A moment of the recording."""

    advice: str
    """What to do now."""
    frame_sets: int
    cameras: dict[str, CameraNow]
    coverage: Coverage | None
    """None where no board was named."""
    ranges: dict[str, RangeCoverage]
    """By camera: regions of the image and distances together, as a report shows them; empty where no board was named."""
    look: int
    """Which look at the board the corners are of; see :meth:`Guide.picture`."""
    events: tuple[str, ...]
    """The last things that went wrong or right again."""
    error: ErrorCourse | None = None
    """None where no expected error was asked for."""

    @property
    def enough(self) -> bool | None:
        """True where nothing more is needed: the expected error that was asked for, or else nothing missing."""
        if self.error is not None:
            return self.error.reached
        return self.coverage.enough if self.coverage else None

    @property
    def next(self) -> str:
        """What to film next: what coverage misses, then what the estimate asks for."""
        if self.coverage is None or self.coverage.next or self.error is None:
            return self.coverage.next if self.coverage else ""
        return next(iter(self.error.film), "show the board to two cameras or more, near and far, tilted both ways")


class Guide:
    """Collects views and events; every method may be called from any thread."""

    def __init__(self, cameras: Sequence[str], board: Board | None, params: CoverageParams | None = None) -> None:
        self._lock = threading.Lock()
        self._all = tuple(cameras)
        self._judged = tuple(cameras)
        self._board = board
        self._params = params or CoverageParams()
        self._placed: list[ViewCoverage] = []
        self._coverage: Coverage | None = None
        self._ranges: dict[str, RangeCoverage] = {}
        self._summarize()
        self._advice = ""
        self._frame_sets = 0
        self._events: list[str] = []
        self._live: tuple[str, ...] = self._all
        self._looks: deque[DetectedFrameSet] = deque(maxlen=_LOOKS)
        self._n_looks = 0
        self._error: ErrorCourse | None = None
        self._listeners: list[Callable[[GuideState], None]] = []

    def listen(self, listener: Callable[[GuideState], None]) -> None:
        """Call `listener` with the new state after every change."""
        self._listeners.append(listener)

    def judge(self, cameras: Sequence[str], params: CoverageParams) -> None:
        """From now on ask for coverage of these cameras by these rules."""
        with self._lock:
            self._judged, self._params = tuple(cameras), params
            self._summarize()
        self._tell()

    def advise(self, advice: str) -> None:
        """Say what to do now."""
        with self._lock:
            if advice == self._advice:
                return
            self._advice = advice
        self._tell()

    def estimated(self, error: ErrorCourse) -> None:
        """There is another estimate of the rig's error, or a reason why there is none."""
        with self._lock:
            self._error = error
        self._tell()

    def event(self, text: str) -> None:
        with self._lock:
            self._events = [*self._events, text][-5:]
        self._tell()

    def looked(self, look: DetectedFrameSet, live: Sequence[str]) -> None:
        """A look at the board that is not recorded (yet)."""
        with self._lock:
            self._looks.append(look)
            self._n_looks, self._live = self._n_looks + 1, tuple(live)
        self._tell()

    def seen_live(self, live: Sequence[str]) -> None:
        with self._lock:
            self._live = tuple(live)

    def recorded(self, frame: str, corners: Mapping[str, Corners], sizes: Mapping[str, tuple[int, int]]) -> None:
        """A frame set was recorded; `sizes` are (width, height) px."""
        with self._lock:
            self._frame_sets += 1
        self.known(frame, corners, sizes)

    def written(self, n: int) -> None:
        """So many frame sets are in the recording by now, of those that nobody looked at."""
        with self._lock:
            self._frame_sets = n
        self._tell()

    def known(self, frame: str, corners: Mapping[str, Corners], sizes: Mapping[str, tuple[int, int]]) -> None:
        """The board's place in a frame set that is in the recording."""
        board = self._board
        if board is not None and corners:
            placed = [place_view(v, board, sizes[v.camera], None, self._params) for v in board_views(frame, corners)]
            with self._lock:
                self._placed += placed
                self._summarize()
        self._tell()

    @property
    def coverage(self) -> Coverage | None:
        with self._lock:
            return self._coverage

    def state(self) -> GuideState:
        with self._lock:
            corners = self._looks[-1].corners if self._looks else {}
            cameras = {}
            for camera in self._all:
                pixels = corners[camera][1] if camera in corners else np.zeros((0, 2))
                cameras[camera] = CameraNow(camera in self._live, camera in corners, pixels)
            return GuideState(
                self._advice,
                self._frame_sets,
                cameras,
                self._coverage,
                self._ranges,
                self._n_looks,
                tuple(self._events),
                self._error,
            )

    def picture(self, camera: str, look: int) -> np.ndarray | None:
        """The picture (h, w, 3), R G B, of a look; the oldest that is kept where that one is no more, None where there is none."""
        with self._lock:
            back = min(max(self._n_looks - look, 0), len(self._looks) - 1)
            frames = self._looks[-1 - back].frame_set.frames if self._looks else {}
            return frames[camera].color.pixels if camera in frames else None

    def _summarize(self) -> None:
        if self._board is not None:
            self._coverage = summarize_coverage(self._placed, self._judged, self._params)
            self._ranges = range_coverage(self._placed, self._all)

    def _tell(self) -> None:
        if self._listeners:
            state = self.state()
            for listener in self._listeners:
                listener(state)

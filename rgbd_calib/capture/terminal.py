"""Guidance in the terminal: a live table where there is one, plain lines where there is none."""

from __future__ import annotations

import math
import threading

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from rgbd_calib.capture.expected_error import ErrorCourse
from rgbd_calib.capture.guide import GuideState
from rgbd_calib.views.coverage import CameraCoverage

_SHADES = "·░▒▓█"
_MAX_MISSING = 4


class PlainGuidance:
    """One line for each thing that changed; for logs and pipes."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._lock = threading.Lock()
        self._advice = ""
        self._next = ""
        self._frame_sets = 0
        self._error: ErrorCourse | None = None

    def __enter__(self) -> PlainGuidance:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def note(self, camera: str, text: str) -> None:
        self._say(f"{camera}: {text}" if camera else text)

    def update(self, state: GuideState) -> None:
        with self._lock:
            if state.frame_sets != self._frame_sets:
                self._frame_sets = state.frame_sets
                seen = [camera for camera, now in state.cameras.items() if now.sees_board]
                board = f", board seen by {', '.join(seen) or 'none'}" if state.coverage else ""
                self._say(f"{state.frame_sets} frame set{'s' if state.frame_sets != 1 else ''}{board}")
            missing = state.coverage.missing if state.coverage else ()
            if missing and missing[0] != self._next:
                self._next = missing[0]
                more = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
                self._say(f"still missing: {missing[0]}{more}")
            if self._next and not missing:
                self._next = ""
                self._say(f"{'enough: ' if state.error is None else ''}nothing is missing any more")
            if state.error is not None and state.error != self._error:
                self._error = state.error
                self._say(f"expected error: {state.error.text}")
            if state.advice != self._advice and not state.coverage:
                self._say(state.advice)
            self._advice = state.advice

    def _say(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)


class LiveGuidance:
    """A table that redraws itself, with events scrolling above it."""

    def __init__(self, console: Console) -> None:
        self._live = Live(console=console, refresh_per_second=4, transient=False)

    def __enter__(self) -> LiveGuidance:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def note(self, camera: str, text: str) -> None:
        self._live.console.print(f"{camera}: {text}" if camera else text, markup=False, highlight=False)

    def update(self, state: GuideState) -> None:
        self._live.update(render(state))


def render(state: GuideState) -> Group:
    """The state as a table and sentences."""
    table = Table(title=f"{state.frame_sets} frame sets", title_justify="left", expand=False)
    for heading in ("camera", "now", "views", "image regions", "distance", "tilted"):
        table.add_column(heading)
    for camera, now in state.cameras.items():
        coverage = state.coverage.cameras.get(camera) if state.coverage else None
        live = Text("no frames", "red") if not now.live else Text("board", "green") if now.sees_board else Text("-")
        table.add_row(Text(camera), live, *_coverage_cells(coverage))
    lines = [Text(state.advice, "bold cyan")] if state.advice else []
    if state.coverage is not None:
        common = [f"{a}-{b} {n}" for (a, b), n in state.coverage.common_frames.items()]
        if common:
            lines.append(Text(f"common views: {', '.join(common)}"))
        lines += [Text(f"still missing: {s}", "yellow") for s in state.coverage.missing[:_MAX_MISSING]]
        if len(state.coverage.missing) > _MAX_MISSING:
            lines.append(Text(f"... and {len(state.coverage.missing) - _MAX_MISSING} more", "yellow"))
        if state.error is not None:
            lines.append(Text(f"expected error: {state.error.text}", "bold green" if state.error.reached else "bold"))
        if state.error is not None and not state.coverage.missing and not state.error.reached:
            lines.append(Text(f"next: {state.next}", "yellow"))
        if state.enough:
            lines.append(Text("enough", "bold green"))
    return Group(table, *lines)


def _coverage_cells(coverage: CameraCoverage | None) -> tuple[Text, ...]:
    if coverage is None:
        return (Text(""),) * 4
    regions = "\n".join("".join(_SHADES[min(n, len(_SHADES) - 1)] * 2 for n in row) for row in coverage.regions)
    seen = not math.isnan(coverage.nearest_m)
    distance = f"{coverage.nearest_m:.2f}-{coverage.farthest_m:.2f} m" if seen else ""
    return Text(str(coverage.views)), Text(regions), Text(distance), Text(str(int(coverage.tilts[1:].sum())))


def guidance(console: Console, live: bool) -> PlainGuidance | LiveGuidance:
    """The live table in a terminal, unless something else needs to write there; else plain lines."""
    return LiveGuidance(console) if live and console.is_terminal else PlainGuidance(console)

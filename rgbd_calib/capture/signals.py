"""Ctrl-C as a wish for an orderly end, instead of an exception anywhere."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_waiting_for_keyboard = threading.Event()


@contextmanager
def stopping_on_signals(stop: threading.Event) -> Iterator[None]:
    """Within, INT and TERM set `stop`; a second one raises KeyboardInterrupt."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, frame: FrameType | None) -> None:
        again = stop.is_set()
        stop.set()
        if again or _waiting_for_keyboard.is_set():
            raise KeyboardInterrupt

    earlier = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in earlier.items():
            signal.signal(number, handler)


@contextmanager
def waiting_for_keyboard() -> Iterator[None]:
    """Within, the first Ctrl-C raises KeyboardInterrupt already: reading a line would not notice otherwise."""
    _waiting_for_keyboard.set()
    try:
        yield
    finally:
        _waiting_for_keyboard.clear()

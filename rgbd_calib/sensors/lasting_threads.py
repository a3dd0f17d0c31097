"""Threads that never end, for all that calls a driver in the background.

OpenNI2's runtime remembers each thread that ever called it, and crashes when a new one calls after another has ended.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from queue import Empty, SimpleQueue

_free: SimpleQueue[SimpleQueue[tuple[Callable[[], None], Future[None]]]] = SimpleQueue()
"""What threads without work wait for."""


def run_lasting(function: Callable[[], None]) -> Future[None]:
    """Run a function in a thread that lasts: one that has nothing to do, or a new one."""
    try:
        work = _free.get_nowait()
    except Empty:
        work = SimpleQueue()
        threading.Thread(target=_last, args=(work,), name="driver", daemon=True).start()
    done: Future[None] = Future()
    work.put((function, done))
    return done


def _last(work: SimpleQueue[tuple[Callable[[], None], Future[None]]]) -> None:
    while True:
        function, done = work.get()
        try:
            function()
        except Exception as error:  # told as that of any thread
            threading.excepthook(
                threading.ExceptHookArgs((type(error), error, error.__traceback__, threading.current_thread()))
            )
        done.set_result(None)
        _free.put(work)

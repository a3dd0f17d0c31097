"""Threads that never end, for libraries that remember each thread by which they were called and crash once one of them has ended."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

T = TypeVar("T")


class LastingThread:
    """Runs functions for another thread, one after the other, and is taken by the next user when it is given back."""

    _free: SimpleQueue[LastingThread] = SimpleQueue()

    def __init__(self) -> None:
        self._calls: SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = SimpleQueue()
        threading.Thread(target=self._run, name="lasting", daemon=True).start()

    @classmethod
    def take(cls) -> LastingThread:
        """One that nobody uses."""
        try:
            return cls._free.get_nowait()
        except Empty:
            return cls()

    def give_back(self) -> None:
        self._free.put(self)

    def call(self, function: Callable[[], T]) -> T:
        """What `function` returns or raises there."""
        done: Future[T] = Future()
        self._calls.put((function, done))
        return done.result()

    def _run(self) -> None:
        while True:
            function, done = self._calls.get()
            try:
                done.set_result(function())
            except BaseException as error:
                done.set_exception(error)

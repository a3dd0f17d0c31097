"""Where many images are worked on: processes of this computer, or a Dask cluster; and where what was found is kept.

What is sent out is small (paths and settings); the workers read the images themselves. Only a few pieces of work for each
worker are out at a time, and the results come back in the order of the work, so that neither how many workers there are
nor which is the fastest can be seen in them. A piece of work whose worker died is given to another one.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import cv2
from threadpoolctl import threadpool_limits

from rgbd_calib.errors import CalibrationError
from rgbd_calib.io.processes import HAS_FORKSERVER, context

Item = TypeVar("Item")
Result = TypeVar("Result")
FEW = 12
"""So many pieces of work are done in this process, while the others start: for less they need not."""
AHEAD = 4
"""Pieces of work out at a time, for each worker: none waits while the results before its own are awaited."""
DEATHS = 2
"""Workers that may die of one piece of work; the second has the computer's memory to itself."""


def _silent(text: str) -> None:
    """Nobody is told."""


@dataclass(frozen=True)
class Workers:
    """How images are worked on. The result depends on none of this."""

    jobs: int | None = None
    """Processes; None: as many as there are cores; 1: this process."""
    dask: str | None = None
    """Address of a Dask scheduler, such as tcp://10.0.0.1:8786, in place of own processes."""
    cache: Path | None = None
    """Folder in which detections are kept; None: they are not."""
    say: Callable[[str], object] = _silent
    """Takes a sentence for the user."""

    def in_order(self, function: Callable[[Item], Result], work: Iterable[Item | Ready[Result]]) -> Iterator[Result]:
        """`function` of every item, in order; `work` is drawn from as workers become free.

        `function` and the items are pickled: a function of a module. A :class:`Ready` stands for its own value.

        Raises
        ------
        CalibrationError
            A worker died twice of the same item.
        ConfigError
            The cluster cannot be reached.
        """
        pool = self._pool()
        window: deque[tuple[Any, Any]] = deque()
        try:
            for item in work:
                window.append((item, None if isinstance(item, Ready) else pool.submit(function, item)))
                while window and (len(window) > pool.ahead or isinstance(window[0][0], Ready)):
                    yield _first(pool, function, window)
            while window:
                yield _first(pool, function, window)
        finally:
            pool.close()

    def _pool(self) -> Pool:
        if self.dask is not None:
            from rgbd_calib.pipeline.dask_workers import Cluster

            return Cluster(self.dask, self.say)
        jobs = self.jobs or _cores()
        return _Here() if jobs == 1 else _Processes(jobs, self.say)


@dataclass(frozen=True)
class Ready(Generic[Result]):
    """A result that is known already."""

    value: Result


class Pool(Protocol):
    """What runs the work; as much of concurrent.futures as is needed here."""

    ahead: int

    def submit(self, function: Callable[[Any], Any], item: Any) -> Any: ...

    def result(self, function: Callable[[Any], Any], item: Any, future: Any, later: deque[tuple[Any, Any]]) -> Any:
        """The result of `item`; where workers died, `later` is submitted again."""

    def close(self) -> None: ...


def _first(pool: Pool, function: Callable[[Any], Any], window: deque[tuple[Any, Any]]) -> Any:
    item, future = window.popleft()
    return item.value if isinstance(item, Ready) else pool.result(function, item, future, window)


class _Here:
    """This process, one item after the other."""

    ahead = 0

    def submit(self, function: Callable[[Any], Any], item: Any) -> None:
        return None

    def result(self, function: Callable[[Any], Any], item: Any, future: None, later: deque[tuple[Any, Any]]) -> Any:
        with one_thread():
            return function(item)

    def close(self) -> None:
        pass


_HERE: Future[Any] = Future()
"""Stands for work that this process does when its result is due."""


class _Processes:
    """Processes of this computer; as safe in a program with threads as on systems that cannot fork."""

    def __init__(self, jobs: int, say: Callable[[str], object]) -> None:
        self.ahead = AHEAD * jobs + FEW
        self._say, self._jobs = say, jobs
        self._executor: ProcessPoolExecutor | None = None
        self._submitted = 0

    def submit(self, function: Callable[[Any], Any], item: Any) -> Future[Any] | None:
        """The future, or None where a worker has just died: `result` will see to it."""
        self._submitted += 1
        if self._submitted <= FEW:
            return _HERE
        if self._executor is None:
            self._executor = ProcessPoolExecutor(self._jobs, _context(function.__module__), _begin)
        try:
            return self._executor.submit(function, item)
        except BrokenExecutor:
            return None

    def result(
        self, function: Callable[[Any], Any], item: Any, future: Future[Any] | None, later: deque[tuple[Any, Any]]
    ) -> Any:
        if future is _HERE:
            with one_thread():
                return function(item)
        deaths = 0
        while True:
            try:
                if future is not None:
                    return future.result()
            except BrokenExecutor:
                pass
            deaths += 1
            if deaths == DEATHS:
                raise CalibrationError(
                    f"{item}: the process that works on it dies, even alone; memory for one image is needed. Free some, or "
                    "see what --jobs 1 says"
                )
            future = self._again(function, item, later)

    def _again(self, function: Callable[[Any], Any], item: Any, later: deque[tuple[Any, Any]]) -> Future[Any] | None:
        """A single new process for this item and all that were lost with it."""
        self._say("A worker process died (out of memory?); going on with one process")
        self.close()
        self._jobs, self._executor = 1, None
        future = self.submit(function, item)
        for k, (other, old) in enumerate(later):
            if not isinstance(other, Ready) and _lost(old):
                later[k] = (other, self.submit(function, other))
        return future

    def close(self) -> None:
        if self._executor is not None:
            self._executor.shutdown(wait=True, cancel_futures=True)


def _lost(future: Future[Any] | None) -> bool:
    if future is _HERE:
        return False
    return future is None or future.cancelled() or not future.done() or isinstance(future.exception(), BrokenExecutor)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _context(module: str) -> multiprocessing.context.BaseContext:
    """Processes forked from one that has imported `module` and runs no threads; where there is none, new ones."""
    if not HAS_FORKSERVER:
        return context("spawn")
    server = context("forkserver")
    server.set_forkserver_preload([module])
    return server


def _begin() -> None:
    """In a new worker: Ctrl-C is the parent's, and without a parent there is nothing to live for."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)  # one image a process is faster than several threads an image
    threadpool_limits(1, user_api="blas")
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_die_with, args=(parent.sentinel,), daemon=True).start()


def _die_with(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)


@contextmanager
def one_thread() -> Iterator[None]:
    """OpenCV and linear algebra in one thread, as they were afterwards."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        cv2.setNumThreads(before)

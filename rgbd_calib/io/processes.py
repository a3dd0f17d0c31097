"""Processes that do not run the caller's script again: a script then needs no `if __name__ == "__main__"`.

`spawn` and `forkserver` import the caller's `__main__` in every new process, so that a script without that guard would start
the same work in each. What is sent to processes here is in modules of this package, and needs no `__main__`.
"""

from __future__ import annotations

import copy
import multiprocessing
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.context import BaseContext
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal

Start = Literal["spawn", "forkserver"]
HAS_FORKSERVER = "forkserver" in multiprocessing.get_all_start_methods()
_MAIN = threading.Lock()

if TYPE_CHECKING:
    from multiprocessing.context import SpawnProcess
    from multiprocessing.context import SpawnProcess as ForkServerProcess
else:
    SpawnProcess = multiprocessing.get_context("spawn").Process
    ForkServerProcess = multiprocessing.get_context("forkserver").Process if HAS_FORKSERVER else SpawnProcess


class SpawnedAlone(SpawnProcess):
    """A new interpreter that knows nothing of the caller's `__main__`."""

    @staticmethod
    def _Popen(process_obj: Any) -> Any:
        with _no_main():
            return SpawnProcess._Popen(process_obj)  # type: ignore[attr-defined]


class ForkedAlone(ForkServerProcess):
    """The same, forked from the server."""

    @staticmethod
    def _Popen(process_obj: Any) -> Any:
        with _no_main():
            return ForkServerProcess._Popen(process_obj)  # type: ignore[attr-defined]


def context(start: Start) -> BaseContext:
    """The context of multiprocessing with this start method, its processes without the caller's `__main__`."""
    own: Any = copy.copy(multiprocessing.get_context(start))
    own.Process = SpawnedAlone if start == "spawn" else ForkedAlone
    found: BaseContext = own
    return found


@contextmanager
def _no_main() -> Iterator[None]:
    """While it lasts, multiprocessing finds nothing to import as `__main__`."""
    with _MAIN:
        main = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = main

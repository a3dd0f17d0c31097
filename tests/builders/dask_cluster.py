"""A Dask cluster on this computer, whose processes may be killed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path


def wait_for(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


class Cluster:
    """A Dask scheduler and two workers, each a process of its own that may be killed."""

    def __init__(self, folder):
        self.folder, self.processes = folder, []
        tests = Path(__file__).parents[1]
        folders = [tests.parent, *(path for path in tests.iterdir() if path.is_dir())]
        self.environment = os.environ | {
            "DASK_DISTRIBUTED__WORKER__MEMORY__TERMINATE": "False",
            # the functions above, the package that is tested, and what this process imports
            "PYTHONPATH": os.pathsep.join([*map(str, folders), *filter(None, [os.environ.get("PYTHONPATH")])]),
        }
        self._start("scheduler", "--port", "0", "--scheduler-file", folder / "scheduler.json", "--no-dashboard")
        written = folder / "scheduler.json"
        wait_for(lambda: written.exists() and written.read_text().endswith("}"))  # it is there before its text is
        self.address = json.loads(written.read_text())["address"]
        self.workers = [self.start_worker() for _ in range(2)]

    def start_worker(self):
        return self._start("worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard")

    def _start(self, what, *args):
        command = [sys.executable, "-m", "dask", what, "--host", "127.0.0.1", *map(str, args)]
        with (self.folder / "log.txt").open("a") as log:
            started = subprocess.Popen(command, cwd=self.folder, env=self.environment, stderr=log, stdout=log)
        self.processes.append(started)
        return started

    def close(self):
        for started in reversed(self.processes):
            started.kill()
            started.wait()

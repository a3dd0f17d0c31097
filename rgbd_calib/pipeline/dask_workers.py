"""A Dask cluster that stands already, in place of own processes (https://distributed.dask.org)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import cv2
from threadpoolctl import threadpool_limits

from rgbd_calib.errors import CalibrationError, ConfigError
from rgbd_calib.pipeline.workers import AHEAD

CONNECT_S = 10.0
"""For the scheduler to answer, and for a first worker to be there."""
PATIENCE_S = 30.0
"""Without a result and without a worker, the user is told what is waited for."""


class Cluster:
    """The cluster's workers; a piece of work whose worker died goes to another one, three times by the cluster's default."""

    def __init__(self, address: str, say: Callable[[str], object]) -> None:
        try:
            from distributed import Client
        except ImportError:
            raise ConfigError(
                "--dask: the package distributed is not installed. Install it: pip install 'rgbd-calib[dask]'"
            ) from None
        self._address, self._say, self._waited = address, say, False
        try:
            self._client = Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise ConfigError(
                f"--dask {address}: no Dask scheduler answers there ({error}); an address such as tcp://10.0.0.1:8786 is "
                "needed. Start one with `dask scheduler`, and `dask worker ADDRESS` on each computer"
            ) from None
        try:
            self._client.wait_for_workers(1, timeout=CONNECT_S)
        except TimeoutError:
            self.close()
            raise ConfigError(
                f"--dask {address}: the cluster has no workers. Start some with `dask worker {address}`"
            ) from None
        self.ahead = AHEAD * sum(self._client.nthreads().values())

    def submit(self, function: Callable[[Any], Any], item: Any) -> Any:
        return self._client.submit(_one_thread, function, item, pure=False)

    def result(self, function: Callable[[Any], Any], item: Any, future: Any, later: deque[tuple[Any, Any]]) -> Any:
        from concurrent.futures import CancelledError

        from distributed import KilledWorker
        from distributed.comm import CommClosedError

        while True:
            try:
                return future.result(timeout=PATIENCE_S)
            except TimeoutError:
                self._tell()
            except KilledWorker:
                raise CalibrationError(
                    f"{item}: every worker that works on it dies; memory for one image is needed. See the workers' logs"
                ) from None
            except ImportError as error:
                raise self._lacks(error) from None
            except RuntimeError as error:  # the scheduler reads the work too
                if "deserialization" not in str(error):
                    raise
                raise self._lacks(error.__cause__ or "its scheduler cannot read it") from None
            except (CancelledError, CommClosedError, OSError):
                raise ConfigError(
                    f"--dask {self._address}: the scheduler is gone. Start it again, and run this again: what was found "
                    "until now is kept, unless --no-cache was given"
                ) from None

    def close(self) -> None:
        self._client.close(timeout=CONNECT_S)

    def _lacks(self, why: object) -> ConfigError:
        return ConfigError(
            f"--dask {self._address}: the cluster cannot do this work ({why}); its scheduler and every worker need rgbd-calib. "
            "Install it where they run, the same version as here"
        )

    def _tell(self) -> None:
        if not self._waited and not self._client.nthreads():
            self._say(f"--dask {self._address}: the cluster has lost its workers; waiting for new ones")
            self._waited = True


def _one_thread(function: Callable[[Any], Any], item: Any) -> Any:
    cv2.setNumThreads(1)  # the cluster gives one image to each of its threads
    threadpool_limits(1, user_api="blas")
    return function(item)

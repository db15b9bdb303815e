"""What analyses in parallel: processes on this machine, or a Dask cluster, both as executors of `concurrent.futures`."""

from __future__ import annotations

import concurrent.futures
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Any, Protocol, Self

from pcw_description.one_heap import one_heap

from ..errors import MismatchError

# Tasks per worker that are handed out beyond the one it works at, so that it never waits.
AHEAD = 2
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
CONNECT_TIMEOUT = 20.0  # [s]


class Workers(Protocol):
    """Runs functions elsewhere."""

    @property
    def in_flight(self) -> int:
        """Most tasks to hand out at once."""

    def submit(self, function: Callable[..., Any], *arguments: Any) -> concurrent.futures.Future[Any]:
        """Run a function on a worker."""

    def restart(self) -> None:
        """Begin again with new workers, after one has died and taken the others' work with it."""


class LocalWorkers:
    """Processes of our own, each with one thread: as many recordings at a time as there are workers."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.in_flight = AHEAD * count
        # Inherited by the workers. Threads of a linear-algebra library would fight for the cores of the other workers.
        for name in ONE_THREAD:
            os.environ.setdefault(name, "1")
        self._pool = self._new_pool()

    def _new_pool(self) -> concurrent.futures.ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")  # no copies of our memory, and the same on every platform
        return concurrent.futures.ProcessPoolExecutor(self.count, context, _begin_worker)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> concurrent.futures.Future[Any]:
        """Run a function in a worker process."""
        return self._pool.submit(function, *arguments)

    def restart(self) -> None:
        """Begin again with new processes."""
        self._pool.shutdown(cancel_futures=True)
        self._pool = self._new_pool()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the workers; when interrupted, without waiting for what they are at."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        if error is not None:
            for process in multiprocessing.active_children():
                process.terminate()
        self._pool.shutdown()


def _begin_worker() -> None:
    """Leave Ctrl-C to the process that handed out the work, and end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    one_heap()
    parent = multiprocessing.parent_process()
    if parent is not None:

        def follow() -> None:
            parent.join()
            os._exit(1)

        threading.Thread(target=follow, daemon=True).start()


class DaskWorkers:
    """A Dask cluster. Its workers need these packages, and the recordings under the same paths."""

    def __init__(self, address: str) -> None:
        """Connect.

        Raises:
            MismatchError: `distributed` is not installed, or nobody answers at the address.
        """
        try:
            import distributed
        except ImportError:
            raise MismatchError(
                "--scheduler needs the Python package distributed (pip install distributed); without --scheduler the "
                "recordings are analysed on this machine"
            ) from None
        try:
            self._client = distributed.Client(address, timeout=CONNECT_TIMEOUT)
            self._client.wait_for_workers(1, timeout=CONNECT_TIMEOUT)
        except (OSError, ValueError, TimeoutError) as error:
            raise MismatchError(f"--scheduler {address}: no Dask cluster with workers answers there: {error}") from error
        self._executor = self._client.get_executor(pure=False)

    @property
    def in_flight(self) -> int:
        """Follows the cluster as it grows and shrinks."""
        return AHEAD * max(1, sum(self._client.nthreads().values()))

    def submit(self, function: Callable[..., Any], *arguments: Any) -> concurrent.futures.Future[Any]:
        """Run a function on the cluster."""
        future: concurrent.futures.Future[Any] = self._executor.submit(function, *arguments)
        return future

    def restart(self) -> None:
        """Do nothing: a cluster replaces its workers itself."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Take back what is not done, and leave the cluster running."""
        self._executor.shutdown(wait=False)
        self._client.close()

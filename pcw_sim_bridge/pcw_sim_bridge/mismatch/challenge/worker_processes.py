"""Runs tasks in processes of their own: one that fails or dies takes no other with it, and each is measured."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from pcw_description.errors import PcwError
from pcw_description.one_heap import one_heap
from pcw_description.one_thread import one_thread


@dataclasses.dataclass(frozen=True)
class Done:
    """What became of a task.

    Attributes:
        name: of the task.
        result: what its function returned; None if it failed.
        error: why it failed, one line; "" if it did not.
        seconds: wall time; peak_bytes: most memory of its process while it ran.
    """

    name: str
    result: Any
    error: str
    seconds: float
    peak_bytes: int


class _Worker:
    """A process that takes one task at a time."""

    def __init__(self, function: Callable[..., Any]) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process: BaseProcess = context.Process(target=_serve, args=(theirs, function), daemon=True)
        self.process.start()
        theirs.close()
        self.task = ""

    def stop(self) -> None:
        self.connection.close()
        self.process.terminate()
        self.process.join()


def run_tasks(
    function: Callable[..., Any], tasks: Iterable[tuple[str, tuple[Any, ...]]], workers: int
) -> Iterator[Done]:
    """Call a function for every task and yield what became of each, as they end.

    Args:
        function: of a module's top level.
        tasks: name and arguments.
        workers: number of processes.
    """
    waiting = list(tasks)[::-1]
    busy: list[_Worker] = []
    try:
        while waiting and len(busy) < workers:
            busy.append(_handed(_Worker(function), waiting))
        while busy:
            for ready in wait([worker.connection for worker in busy]):
                worker = next(w for w in busy if w.connection is ready)
                busy.remove(worker)
                name = worker.task
                try:
                    done = Done(name, *worker.connection.recv())
                except (EOFError, ConnectionResetError):
                    worker.process.join()
                    done = Done(name, None, f"its process ended with code {worker.process.exitcode}", 0.0, 0)
                    worker.stop()
                    worker = _Worker(function) if waiting else worker
                if waiting:
                    busy.append(_handed(worker, waiting))
                elif worker.process.is_alive():
                    worker.stop()
                yield done
    finally:
        for worker in busy:
            worker.stop()


def _handed(worker: _Worker, waiting: list[tuple[str, tuple[Any, ...]]]) -> _Worker:
    worker.task, arguments = waiting.pop()
    worker.connection.send(arguments)
    return worker


def _serve(connection: Connection, function: Callable[..., Any]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends us
    one_thread()  # threads of linear algebra would spin on the cores of the other workers
    one_heap()
    os.dup2(2, 1)  # an engine that prints when it is loaded does not print among the parent's results
    while True:
        try:
            arguments = connection.recv()
        except EOFError:
            return
        _forget_peak()
        begun = time.monotonic()
        result, error = None, ""
        try:
            result = function(*arguments)
        except PcwError as failure:
            error = str(failure)
        except Exception as failure:
            error = f"{type(failure).__name__}: {failure}"
        try:
            connection.send((result, error, time.monotonic() - begun, _peak()))
        except BrokenPipeError:
            return  # the parent was killed


def _forget_peak() -> None:
    """Begin to measure the peak anew, where the system can (Linux)."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pass  # then the peak is that of all tasks of this process so far


def _peak() -> int:
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024

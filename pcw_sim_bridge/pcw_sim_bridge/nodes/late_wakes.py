"""How late the computer wakes a process that only sleeps: what no program on it can be better than.

    wakes = LateWakes(priority=40)
    with wakes:
        ...
    print(wakes.largest)

A virtual machine stands still now and then, for as long as its host likes; what a trial measures then is the host.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from multiprocessing.connection import Connection
from types import TracebackType

SLEEP = 1e-3  # [s]
LATE = 5e-3  # what is counted [s]


class LateWakes:
    """A process of its own that sleeps, a millisecond at a time, and notes how late it was woken.

    Attributes:
        largest: delay [s]; count: how many were above `LATE`; both of the time between entry and exit.
    """

    def __init__(self, priority: int = 0) -> None:
        """Start the process, which takes a second; priority: real-time, to sleep at; 0: an ordinary process."""
        self.largest, self.count = 0.0, 0
        self._here, there = multiprocessing.Pipe()
        self._process = multiprocessing.get_context("spawn").Process(target=_sleep, args=(there, priority), daemon=True)
        self._process.start()
        self._here.recv()

    def __enter__(self) -> LateWakes:
        """Begin."""
        self._here.send(None)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """End, and take what was noted."""
        if self._process.is_alive():
            self._here.send(None)
            self.largest, self.count = self._here.recv()
        self._process.join(5.0)


def _sleep(pipe: Connection, priority: int) -> None:
    """Wait until told to begin, then sleep until told to end; send the largest delay [s] and how many were above `LATE`."""
    if priority:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    pipe.send(None)
    pipe.recv()
    largest, count = 0.0, 0
    while not pipe.poll():
        begun = time.monotonic()
        time.sleep(SLEEP)
        late = time.monotonic() - begun - SLEEP
        largest, count = max(largest, late), count + (late > LATE)
    pipe.send((largest, count))

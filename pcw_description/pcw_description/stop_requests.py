"""SIGINT and SIGTERM as a note that a loop looks at, or as an error that nothing swallows.

An interrupt that is raised where it comes can fall into compiled code, which may swallow it, or into half of a step.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any

INSISTENT = 1.0  # a signal so long after the first [s] ends what does not look
# When an interrupt is tried again that is put off, and one that got nowhere [s]; workers that it ends may take as long.
PUT_OFF, SWALLOWED = 0.02, 3.0
# An error from outside that begins here leaves a lock closed: other threads that compile would wait for ever.
LOCKS = ("numba.core.compiler_lock", "llvmlite.binding.ffi")


@contextmanager
def stop_requests() -> Iterator[Sequence[float]]:
    """Collect the times [s, monotonic] of SIGINT and SIGTERM instead of letting them end the process.

    Raises:
        KeyboardInterrupt: of a later, insistent signal, where it comes.
    """
    received: list[float] = []

    def request_stop(number: int, frame: FrameType | None) -> None:
        received.append(time.monotonic())
        # a terminal and a parent may both deliver the same Ctrl-C, so only a later one is an insistent one
        if received[-1] - received[0] > INSISTENT:
            raise KeyboardInterrupt

    try:
        previous = {number: signal.signal(number, request_stop) for number in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:  # not in the main thread (a test that spins a node): whoever started it stops it
        previous = {}
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def interrupts() -> Iterator[None]:
    """Raise KeyboardInterrupt in the main thread for SIGINT, ignored or not, and for SIGTERM, until it gets through.

    It is put off where Python would only report an error and go on (`__del__`), and where an error from outside leaves a
    lock closed. Callbacks of compiled code may still swallow it, so it is raised again until the context is left.
    """
    before: dict[signal.Signals, Any] = {}

    def interrupt(number: int, frame: FrameType | None) -> None:
        if signal.SIGALRM not in before:  # the clock belongs to whoever uses it until there is need of it
            before[signal.SIGALRM] = signal.signal(signal.SIGALRM, interrupt)
        put_off = frame is not None and _swallowed(frame)
        signal.setitimer(signal.ITIMER_REAL, PUT_OFF if put_off else SWALLOWED)
        if not put_off:
            raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM):
        before[number] = signal.signal(number, interrupt)
    try:
        yield
    finally:
        if signal.SIGALRM in before:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)


def _swallowed(frame: FrameType) -> bool:
    """Whether an error that begins in this frame is only reported, or leaves a lock closed."""
    inner = frame.f_globals.get("__name__") in LOCKS
    outer: FrameType | None = frame
    while outer is not None and outer.f_code.co_name != "__del__":
        outer = outer.f_back
    return inner or outer is not None

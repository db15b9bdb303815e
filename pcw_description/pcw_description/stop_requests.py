"""SIGINT and SIGTERM as a note that a loop looks at.

An interrupt that is raised where it comes can fall into compiled code, which may swallow it, or into half of a step.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

INSISTENT = 1.0  # a signal so long after the first [s] ends what does not look


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

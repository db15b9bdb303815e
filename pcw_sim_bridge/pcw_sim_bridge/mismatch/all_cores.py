"""The one way the analyser uses several cores: threads, since numpy, scipy's filters and our kernels let others run."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
Other = TypeVar("Other")


def on_all_cores(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Return what `work` makes of every item, in their order; an error ends it and is raised.

    Args:
        work: must not change what the items share.
        items: what to work on.
    """
    cores = min(_cores(), len(items))
    if cores < 2:
        return [work(item) for item in items]
    with ThreadPoolExecutor(cores) as pool:
        return list(pool.map(work, items))


def side_by_side(work: Callable[[], Result], other: Callable[[], Other]) -> tuple[Result, Other]:
    """Return what two pieces of work make that have nothing to do with each other; interrupts reach the first at once."""
    if _cores() < 2:
        return work(), other()
    with ThreadPoolExecutor(1) as pool:
        made = pool.submit(other)
        return work(), made.result()


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

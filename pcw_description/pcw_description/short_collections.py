"""Short garbage collections, for processes that must answer in time."""

from __future__ import annotations

import gc


def short_collections() -> None:
    """Leave all that is there now out of every later garbage collection.

    Modules and what a process has set up stay as long as it does. To look through them takes tens of milliseconds, now and
    then and in the middle of a period: longer than drives wait for a command.
    """
    gc.collect()
    gc.freeze()

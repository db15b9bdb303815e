"""One heap of the C library for all threads of a process that computes with large arrays on several of them."""

from __future__ import annotations

import ctypes

M_ARENA_MAX = -8  # of mallopt, see malloc.h of glibc


def one_heap() -> None:
    """Let all threads that begin after this share one heap, where the C library has this setting (glibc).

    Each thread would get a heap of its own, and keep what large arrays have left there free for itself. The interpreter's
    lock lets hardly two threads ask for memory at the same time.
    """
    try:
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, 1)
    except (AttributeError, OSError, TypeError):  # another C library has no such setting, or cannot be asked like this
        return

"""Linear algebra on one thread, for processes that must answer in time."""

from __future__ import annotations


def one_thread() -> None:
    """Keep the library of numpy and scipy to one thread, where threadpoolctl is there to do so.

    A node's matrices are small. Threads gain nothing on them, and spin for a while after each product: at a real-time
    priority that keeps everything else of this priority from running, for longer than drives wait for a command.
    """
    try:
        import threadpoolctl
    except ImportError:  # an extra
        return
    threadpoolctl.threadpool_limits(1)

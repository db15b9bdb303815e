"""Interrupts as notes: none is lost, and none comes where compiled code could swallow it."""

from __future__ import annotations

import signal
import threading
import time

import pytest

from pcw_description import stop_requests as module
from pcw_description.stop_requests import stop_requests


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_noted_and_raises_nothing(signum):
    before = signal.getsignal(signum)
    with stop_requests() as stops:
        assert not stops
        signal.raise_signal(signum)
        signal.raise_signal(signum)  # a terminal and a parent may both deliver one Ctrl-C
        assert len(stops) == 2 and stops[0] <= time.monotonic()
    assert signal.getsignal(signum) is before


def test_who_insists_is_heard_at_once(monkeypatch):
    monkeypatch.setattr(module, "INSISTENT", 0.0)
    with stop_requests() as stops:
        signal.raise_signal(signal.SIGINT)
        time.sleep(0.001)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    assert len(stops) == 2


def test_in_another_thread_nothing_is_changed():
    before = signal.getsignal(signal.SIGINT)
    seen = []

    def body() -> None:
        with stop_requests() as stops:
            seen.append((list(stops), signal.getsignal(signal.SIGINT)))

    thread = threading.Thread(target=body)
    thread.start()
    thread.join()
    assert seen == [([], before)]

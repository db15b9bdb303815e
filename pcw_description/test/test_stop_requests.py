"""Interrupts as notes: none is lost, and none comes where compiled code could swallow it."""

from __future__ import annotations

import signal
import threading
import time

import pytest

from pcw_description import stop_requests as module
from pcw_description.stop_requests import LOCKS, interrupts, stop_requests


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


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_is_raised_and_afterwards_all_is_as_it_was(signum):
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)
    before = [signal.getsignal(number) for number in numbers]
    with pytest.raises(KeyboardInterrupt), interrupts():
        signal.raise_signal(signum)
    assert [signal.getsignal(number) for number in numbers] == before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_an_interrupt_that_was_swallowed_is_raised_again(monkeypatch):
    monkeypatch.setattr(module, "SWALLOWED", 0.05)
    swallowed = []
    with pytest.raises(KeyboardInterrupt), interrupts():
        for _ in range(3):
            try:
                if not swallowed:
                    signal.raise_signal(signal.SIGTERM)
                time.sleep(10.0)
            except KeyboardInterrupt as error:
                swallowed.append(error)
                if len(swallowed) == 3:
                    raise
    assert len(swallowed) == 3


class Interrupted:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)
        time.sleep(0.1)
        done.append("what Python would have broken off, and reported")


done: list[str] = []


def in_module(name: str):
    """Return a function of a module of this name that is interrupted and goes on."""
    body = compile("def held():\n  raise_signal(2)\n  sleep(0.1)\n  done.append('lock opened')", name, "exec")
    names = {"__name__": name, "raise_signal": signal.raise_signal, "sleep": time.sleep, "done": done}
    exec(body, names)
    return names["held"]


@pytest.mark.parametrize("where", [Interrupted, *map(in_module, LOCKS)], ids=["__del__", *LOCKS])
def test_where_an_interrupt_would_be_lost_or_do_harm_it_waits(where, capfd):
    done.clear()
    with pytest.raises(KeyboardInterrupt), interrupts():
        where()
        assert len(done) == 1
        time.sleep(10.0)
    assert len(done) == 1
    assert "ignored" not in capfd.readouterr().err


def test_the_locks_are_where_they_are_said_to_be():
    from llvmlite.binding import ffi
    from numba.core import compiler_lock

    assert {compiler_lock.__name__, ffi.__name__} == set(LOCKS)
    assert type(ffi.lib._lock).__module__ == ffi.__name__ and type(compiler_lock.global_compiler_lock).__module__ in LOCKS

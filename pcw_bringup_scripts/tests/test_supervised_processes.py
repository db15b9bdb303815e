"""Children are ended in order and never left behind."""

import os
import signal
import subprocess
import sys
import time

import pytest

from pcw_bringup_scripts import supervised_processes
from pcw_bringup_scripts.supervised_processes import Children, ProcessError, wait_for_end

# Both say "ready" once a signal does to them what it shall.
STUBBORN = """
import signal, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
print("ready", flush=True)
while True:
    time.sleep(0.05)
"""
POLITE = """
import time
try:
    print("ready", flush=True)
    while True:
        time.sleep(0.05)
except KeyboardInterrupt:
    print("bye")
"""


def ready(child):
    end = time.monotonic() + 30.0
    while "ready" not in child.last_lines():
        assert time.monotonic() < end
        time.sleep(0.02)
    return child


def is_running(pid):
    try:
        with open(f"/proc/{pid}/stat") as stat:
            return stat.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_leaving_the_block_ends_them_gently(tmp_path):
    with Children(tmp_path, os.environ) as children:
        child = ready(children.start("polite", [sys.executable, "-c", POLITE]))
    assert child.process.returncode == 0
    assert child.last_lines().splitlines() == ["ready", "bye"]


def test_who_does_not_listen_is_ended_harder(tmp_path, monkeypatch):
    monkeypatch.setattr(supervised_processes, "ENDING", ((signal.SIGINT, 0.2), (signal.SIGTERM, 10.0)))
    with Children(tmp_path, os.environ) as children:
        child = ready(children.start("stubborn", [sys.executable, "-c", STUBBORN]))
    assert child.process.returncode == -signal.SIGTERM


def test_an_exception_ends_them_too(tmp_path):
    with pytest.raises(KeyboardInterrupt), Children(tmp_path, os.environ) as children:
        child = ready(children.start("polite", [sys.executable, "-c", POLITE]))
        raise KeyboardInterrupt
    assert child.process.returncode == 0


def test_one_that_fails_is_told_with_its_last_words(tmp_path):
    with Children(tmp_path, os.environ) as children:
        children.start("broken", [sys.executable, "-c", "print('no more paper'); raise SystemExit(3)"])
        last = children.start("last", [sys.executable, "-c", POLITE])
        with pytest.raises(ProcessError, match=r"broken ended with code 3; its last words .*\nno more paper"):
            wait_for_end(children, last, deadline=30.0)
    assert last.process.returncode is not None


def test_waiting_ends_with_the_last_child_or_at_the_deadline(tmp_path):
    with Children(tmp_path, os.environ) as children:
        ready(children.start("polite", [sys.executable, "-c", POLITE]))
        quick = children.start("quick", [sys.executable, "-c", "pass"])
        wait_for_end(children, quick, deadline=30.0)
    with Children(tmp_path, os.environ) as children:
        slow = children.start("slow", [sys.executable, "-c", POLITE])
        with pytest.raises(ProcessError, match="slow still runs after 0.3 s"):
            wait_for_end(children, slow, deadline=0.3)


def test_a_killed_parent_leaves_nothing_running(tmp_path):
    """Even SIGKILL, which no handler sees: the simulation would otherwise run on unseen."""
    program = f"""
import os, time
from pathlib import Path
from pcw_bringup_scripts.supervised_processes import Children
children = Children(Path({str(tmp_path)!r}), os.environ)
child = children.start("polite", {[sys.executable, "-c", POLITE]!r})
while "ready" not in child.last_lines():
    time.sleep(0.02)
print(child.process.pid, flush=True)
time.sleep(60)
"""
    parent = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    try:
        pid = int(parent.stdout.readline())
        assert is_running(pid)
    finally:
        parent.kill()
        parent.wait()
    end = time.monotonic() + 30.0
    while is_running(pid):
        assert time.monotonic() < end
        time.sleep(0.02)

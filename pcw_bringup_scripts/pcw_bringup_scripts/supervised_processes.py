"""Child processes that are never left behind: each is ended by its own id, gently first, with deadlines."""

from __future__ import annotations

import ctypes
import dataclasses
import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType

from pcw_description.errors import PcwError

# How long a child may take to end after each signal [s]: a recorder closes its file, a controller lets go of the robot.
ENDING = ((signal.SIGINT, 15.0), (signal.SIGTERM, 5.0), (signal.SIGKILL, 5.0))
_PR_SET_PDEATHSIG = 1


class ProcessError(PcwError):
    """A child process that ended when it should not, or did not end when it should."""


@dataclasses.dataclass(frozen=True)
class Child:
    """One running child.

    Attributes:
        name: what to call it.
        process: the process.
        log: file of all that it prints.
    """

    name: str
    process: subprocess.Popen[bytes]
    log: Path

    def last_lines(self, count: int = 15) -> str:
        """Return the end of what it has printed."""
        return "\n".join(self.log.read_text(errors="replace").splitlines()[-count:])


class Children:
    """A group of child processes; leaving the `with` block ends all of them, in the reverse order of their start."""

    def __init__(self, logs: Path, environment: Mapping[str, str]) -> None:
        self._logs, self._environment = logs, dict(environment)
        self._children: list[Child] = []

    def __enter__(self) -> Children:
        """Return itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """End what still runs."""
        self.end()

    def start(self, name: str, command: Sequence[str]) -> Child:
        """Start a child whose output goes to <logs>/<name>.log."""
        log = self._logs / f"{name}.log"
        with log.open("wb") as output:
            # A session of its own: Ctrl-C in the terminal reaches us alone, and we end the children in order.
            process = subprocess.Popen(
                command, env=self._environment, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
                start_new_session=True, preexec_fn=_prepare,  # noqa: PLW1509 - no threads here
            )
        child = Child(name, process, log)
        self._children.append(child)
        return child

    def check(self) -> None:
        """Raise a ProcessError with its last words if a child has ended with an error, or any but the last has ended."""
        for child in self._children:
            code = child.process.poll()
            if code is not None and (code != 0 or child is not self._children[-1]):
                raise ProcessError(f"{child.name} ended with code {code}; its last words ({child.log}):\n{child.last_lines()}")

    def end(self) -> None:
        """End all children, the one started last first."""
        for child in reversed(self._children):
            for number, patience in ENDING:
                if child.process.poll() is not None:
                    break
                child.process.send_signal(number)
                try:
                    child.process.wait(timeout=patience)
                except subprocess.TimeoutExpired:
                    continue
        self._children.clear()


def wait_for_end(children: Children, last: Child, deadline: float) -> None:
    """Wait until `last` has ended well while all others run.

    Raises:
        ProcessError: another child ended, `last` failed, or the deadline [s] has passed.
    """
    end = time.monotonic() + deadline
    while last.process.poll() is None:
        children.check()
        if time.monotonic() > end:
            raise ProcessError(f"{last.name} still runs after {deadline:g} s; its last words:\n{last.last_lines()}")
        time.sleep(0.1)
    children.check()


def _prepare() -> None:
    """Let this child be interrupted, and ask Linux to do so when its parent is killed: no simulation runs on unseen."""
    # A shell starts a background job with SIGINT ignored, and who ignores it hands that on to its children.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if os.uname().sysname == "Linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGINT)

"""What `analyze` leaves to processes beside it: to read recordings while it is being imported, and to draw side by side.

They are forked while it is small, so that they have at once what it has, and share its memory.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import warnings
from collections.abc import Mapping, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pcw_description.errors import PcwError
from pcw_description.recording import Recording
from pcw_description.robot_description import RobotDescription
from pcw_description.robot_file import load_robot

from .report_drawing import Task

COUNT = 2
LARGEST_READ = 200_000_000  # [bytes]; on its way to us a recording is there twice


class HelperProcesses:
    """Processes that do our tasks; none where the system cannot fork or has one core: then all is done here.

    A context: they end with it.
    """

    def __init__(self) -> None:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
        self._helpers: list[_Helper] = []
        try:
            for _ in range(COUNT if cores > 1 else 0):
                self._helpers.append(_Helper([helper.connection for helper in self._helpers]))
        except OSError:
            pass  # no room for another process, or none allowed
        self._reads: dict[Path, _Helper] = {}
        self._ready = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End them, whatever they are at."""
        for helper in self._helpers:
            helper.process.terminate()
        for helper in self._helpers:
            helper.process.join()
            helper.connection.close()

    def begin(self, paths: Sequence[Path], robot: str, topics: Mapping[str, str]) -> None:
        """Begin to read recordings.

        Args:
            paths: of the recordings, in the order in which they will be opened.
            robot: name or path of the description; that of a bench axis has recordings of another kind, which wait.
            topics: contract topic -> topic in the recordings.
        """
        for number, path in enumerate(dict.fromkeys(paths) if self._helpers else ()):
            if _size(path) <= LARGEST_READ:
                helper = self._helpers[number % len(self._helpers)]
                helper.ask((_read, (path, robot, dict(topics))))
                self._reads[path] = helper
        self._get_ready()

    def open(self, path: Path, robot: RobotDescription, topics: Mapping[str, str]) -> Recording:
        """Return a recording, as `Recording.open`; once that which was read meanwhile.

        Raises:
            RecordingError: as `Recording.open`.
        """
        helper = self._reads.pop(path, None)
        read = None if helper is None else helper.answer()
        self._get_ready()
        return Recording.open(path, robot, topics) if read is None else read

    def _get_ready(self) -> None:
        """Let all import what draws, once nobody waits for what they read."""
        if not self._reads and not self._ready:
            self._ready = True
            for helper in self._helpers:
                helper.ask((_draw_something, ()))

    def do(self, tasks: Sequence[Task]) -> list[Any]:
        """Return what functions of modules' top level make of their arguments, in their order; errors are raised."""
        results: list[Any] = [None] * len(tasks)
        waiting = list(range(len(tasks)))[::-1] if self._helpers else []
        free, at_work = list(self._helpers), dict[Any, tuple[_Helper, int]]()
        for helper in free:
            helper.settle()
        while waiting or at_work:
            while waiting and free:
                helper, task = free.pop(), waiting.pop()
                helper.ask(tasks[task])
                at_work[helper.connection] = helper, task
            for connection in wait(list(at_work)):
                helper, task = at_work.pop(connection)
                results[task] = helper.answer()
                free.append(helper)
        # What failed there fails here, where its error is seen; what did because its process is gone does not.
        return [f(*given) if result is None else result for (f, given), result in zip(tasks, results, strict=True)]


class _Helper:
    """A process that does one task after another, and answers in their order."""

    def __init__(self, of_others: Sequence[Connection]) -> None:
        """Fork it.

        Args:
            of_others: our ends of the connections to others; while anybody holds one, its helper does not see us end.
        """
        context = multiprocessing.get_context("fork")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, [*of_others, self.connection]), daemon=True)
        self._asked = 0
        with warnings.catch_warnings():
            # Of threads that are there already: the linear algebra's own, which are idle and begin anew after a fork.
            warnings.simplefilter("ignore", DeprecationWarning)
            self.process.start()
        theirs.close()

    def ask(self, task: Task) -> None:
        """Hand out a task."""
        try:
            self.connection.send(task)
            self._asked += 1
        except OSError:
            pass  # it is gone, and will not answer

    def answer(self) -> Any:
        """Wait for what became of the first task that is not answered yet; None of one that failed, or of one that is gone."""
        try:
            if self._asked:
                self._asked -= 1
                return self.connection.recv()
        except (EOFError, OSError):
            self._asked = 0
        return None

    def settle(self) -> None:
        """Wait until it has done what it was asked."""
        while self._asked:
            self.answer()


def _serve(connection: Connection, of_others: Sequence[Connection]) -> None:
    """Do tasks until the process that forked us has ended."""
    for other in of_others:
        other.close()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # who forked us ends us
    for number in (signal.SIGTERM, signal.SIGALRM):
        signal.signal(number, signal.SIG_DFL)
    os.dup2(2, 1)  # what a library prints when it is imported is none of the results
    while True:
        try:
            function, arguments = connection.recv()
        except (EOFError, OSError):
            return
        try:
            result = function(*arguments)
        except Exception:
            result = None
        try:
            connection.send(result)
        except OSError:
            return  # nobody listens any more


def _read(path: Path, robot: str, topics: Mapping[str, str]) -> Recording | None:
    """Return a recording, decoded; None where it cannot be read."""
    try:
        return Recording.open(path, load_robot(robot), topics).decoded()
    except PcwError:
        return None  # who wants it learns why


def _size(path: Path) -> int:
    files = [path] if path.is_file() else path.glob("*")
    return sum(file.stat().st_size for file in files)


def _draw_something() -> None:
    """Import what draws, and let it load its fonts and what typesets the labels of a logarithmic axis."""
    from .report_figures import new_figure
    from .report_maps import finish

    figure = new_figure(2.0, 2.0)
    figure.add_subplot().set_yscale("log")
    finish(figure, "", "")

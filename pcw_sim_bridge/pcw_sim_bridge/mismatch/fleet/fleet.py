"""Many recordings of many robots: which there are, whose they are, what is done already, and the rest on workers.

Every recording is analysed alone, by one worker, and its result is one line of `results.jsonl`, appended as it is finished.
That file is the state: whatever interrupts a run, the next one goes on after the last whole line. No more recordings are
in flight than keep the workers busy, and of a recording nothing stays in memory but its line.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import fnmatch
import hashlib
import json
import os
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pcw_description.axis_recording import SUFFIXES as AXIS_SUFFIXES
from pcw_description.errors import PcwError
from pcw_description.recording_files import RecordingFiles, WarningLog

from ..errors import MismatchError
from ..subjects.axis_subject import AxisSubject
from ..subjects.load_subject import load_subject
from ..subjects.subject import Subject, file_digest
from .fleet_workers import Workers

RESULTS = "results.jsonl"
BAG_SUFFIXES = (".mcap", ".db3")
# Stamps before this are no calendar's (2001-09-09) but those of a clock that began with the run.
CALENDAR = 1e9  # [s]

Result = dict[str, Any]


# -- what there is ---------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class FleetRobots:
    """Whose recording is which.

    Attributes:
        patterns: (pattern, description) in the order given; a pattern of None takes every recording.
        subjects: description -> what it describes.
    """

    patterns: tuple[tuple[str | None, str], ...]
    subjects: Mapping[str, Subject]

    @classmethod
    def read(cls, given: Sequence[str]) -> FleetRobots:
        """Read `--robot` options: one DESCRIPTION for all, or PATTERN:=DESCRIPTION, several times.

        Raises:
            PcwError: a description that cannot be loaded, or options that exclude each other.
        """
        patterns: list[tuple[str | None, str]] = []
        for option in given:
            pattern, separator, description = option.partition(":=")
            if separator and not (pattern and description):
                raise MismatchError(f"--robot {option!r} is not allowed; allowed: DESCRIPTION, or PATTERN:=DESCRIPTION")
            if not separator and len(given) > 1:
                raise MismatchError(f"--robot {option!r} beside others is not allowed; allowed: PATTERN:=DESCRIPTION for each")
            description = description if separator else option
            # Workers may stand in another folder.
            absolute = str(Path(description).resolve()) if Path(description).suffix in (".yaml", ".yml") else description
            patterns.append((pattern if separator else None, absolute))
        return cls(tuple(patterns), {description: load_subject(description) for _, description in patterns})

    def robot_of(self, path: Path) -> tuple[str, str] | None:
        """Return name and description of the robot of a recording; None where no pattern fits.

        The name is the folder that a pattern fits: with `amr_*:=thesis`, logs/amr_7/monday is of amr_7.
        """
        for pattern, description in self.patterns:
            if pattern is None:
                return self.subjects[description].name, description
            for part in path.resolve().parent.parts:
                if fnmatch.fnmatchcase(part, pattern):
                    return part, description
        return None

    def reads(self, description: str, path: Path) -> bool:
        """Whether what is described is recorded in files of this kind."""
        axis = isinstance(self.subjects[description], AxisSubject)
        return path.name.endswith(AXIS_SUFFIXES) if axis else not path.name.endswith(AXIS_SUFFIXES)


@dataclasses.dataclass(frozen=True)
class Task:
    """One recording to analyse; what a worker is sent."""

    path: str
    robot: str
    description: str
    description_sha256: str
    topics: Mapping[str, str]
    seed: int


def find_tasks(paths: Iterable[Path], robots: FleetRobots, topics: Mapping[str, str], seed: int) -> list[Task]:
    """Return a task for every recording at or below the paths, in the order of their names, each once.

    Raises:
        MismatchError: a path that is not there, no recordings, or one that belongs to no robot.
    """
    digests = {description: description_digest(subject) for description, subject in robots.subjects.items()}
    found: dict[Path, Task] = {}
    for given in paths:
        if not given.exists():
            raise MismatchError(f"{given}: no such recording or folder")
        for path in recordings_below(given):
            owner = robots.robot_of(path)
            if owner is None:
                patterns = ", ".join(str(pattern) for pattern, _ in robots.patterns)
                raise MismatchError(f"{path} belongs to no robot: no folder that it is in fits --robot {patterns}")
            robot, description = owner
            if path == given or robots.reads(description, path):
                task = Task(str(path.resolve()), robot, description, digests[description], dict(topics), seed)
                found.setdefault(path.resolve(), task)
    if not found:
        raise MismatchError(f"no recordings in {', '.join(map(str, paths))}; allowed: rosbag2 folders, .mcap, .db3")
    return list(found.values())


def recordings_below(path: Path) -> Iterator[Path]:
    """Yield the path itself if it is a recording, else every recording in it and in its folders, by name."""
    if path.is_file() or (path / "metadata.yaml").is_file():
        yield path
        return
    entries = sorted(path.iterdir())
    bags = [entry for entry in entries if entry.suffix in BAG_SUFFIXES]
    if len(bags) == 1:  # a recorder that was killed leaves no metadata
        yield path
        return
    for entry in entries:
        if entry.is_dir():
            yield from recordings_below(entry)
        elif entry.name.endswith((*BAG_SUFFIXES, *AXIS_SUFFIXES)):
            yield entry


def description_digest(subject: Subject) -> str:
    """Return the SHA-256 of a description's content, whatever its layout and comments."""
    content = json.dumps(subject.mapping(), sort_keys=True, default=lambda value: value.tolist())
    return hashlib.sha256(content.encode()).hexdigest()


def recording_digest(path: Path) -> str:
    """Return the SHA-256 of a recording as its result has it."""
    if path.name.endswith(AXIS_SUFFIXES):
        return file_digest(path)
    return RecordingFiles(path, WarningLog()).sha256


# -- what is done ----------------------------------------------------------------------------------------------------


class FleetResults:
    """The results in a folder, by path of the recording; the last line of a path counts."""

    def __init__(self, folder: Path) -> None:
        """Read what is there; a last line that was cut off is taken off the file.

        Raises:
            MismatchError: the folder cannot be used, or holds a file of that name that is none of ours.
        """
        self.path = folder / RESULTS
        self._by_path: dict[str, Result] = {}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            content = self.path.read_bytes() if self.path.exists() else b""
            whole = content.rfind(b"\n") + 1
            self._stream = self.path.open("ab")
            if whole < len(content):
                self._stream.truncate(whole)
        except OSError as error:
            raise MismatchError(f"--out {folder}: cannot be written: {error.strerror or error}") from error
        for number, line in enumerate(content[:whole].splitlines(), start=1):
            try:
                result = json.loads(line)
                self._by_path[result["path"]] = result
            except (ValueError, KeyError, TypeError):
                raise MismatchError(f"{self.path}, line {number}: is no result of mismatch fleet") from None

    def __iter__(self) -> Iterator[Result]:
        """All results, by path."""
        return iter(self._by_path.values())

    def add(self, result: Result) -> None:
        """Append a line; it is on the disk when this returns."""
        self._stream.write(json.dumps(result, allow_nan=False).encode() + b"\n")
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._by_path[result["path"]] = result

    def holds(self, task: Task) -> bool:
        """Whether a recording was analysed as it is now, with the description as it is now; failures count as not done."""
        known = self._by_path.get(task.path)
        if known is None or known["error"] is not None:
            return False
        same = all(known[name] == getattr(task, name) for name in ("robot", "description_sha256", "topics", "seed"))
        return same and bool(known["sha256"] == recording_digest(Path(task.path)))

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


# -- the work --------------------------------------------------------------------------------------------------------


def analyse_task(task: Task) -> Result:
    """Analyse one recording, in a worker. Whatever goes wrong with it is its result: one bad recording is not fatal."""
    # Imported here so that a process that only hands out work stays small.
    from ..analysis import analyse
    from ..report.report import report_json

    path = Path(task.path)
    begun = time.monotonic()
    result: Result = {**dataclasses.asdict(task), "error": None, "sha256": None}
    try:
        findings = analyse(load_subject(task.description), [path], [], task.topics, task.seed, lambda message: None).findings
        content = json.loads(report_json(findings))
    except Exception as error:
        kind = "" if isinstance(error, PcwError) else f"{type(error).__name__}: "
        return {**result, **_time_of(path, None), "error": f"{kind}{error}", "seconds": time.monotonic() - begun}
    [used] = findings.inputs
    kept = ("verdict", "channels", "effects", "unknown", "fit", "retuned", "notes")
    return {
        **result, **_time_of(path, used.started), "sha256": used.sha256, "duration_s": used.duration,
        "warnings": list(used.warnings), **{name: content[name] for name in kept}, "seconds": time.monotonic() - begun,
    }


def _time_of(path: Path, started: float | None) -> Result:
    """When a recording was made: by its stamps where they are a calendar's, else by its file."""
    if started is not None and started > CALENDAR:
        return {"time": started, "time_from": "stamps"}
    try:
        files = [path] if path.is_file() else [entry for entry in path.iterdir() if entry.suffix in BAG_SUFFIXES] or [path]
        return {"time": min(file.stat().st_mtime for file in files), "time_from": "file"}
    except OSError:
        return {"time": 0.0, "time_from": "unknown"}


def analyse_all(tasks: Iterable[Task], workers: Workers) -> Iterator[Result]:
    """Yield the results of all tasks as they are finished, with no more tasks in flight than keep the workers busy.

    A worker that dies (memory, a crash in compiled code) takes what was in flight with it. Each of these recordings is then
    analysed alone, and one at which a worker dies again is the bad one.
    """
    waiting = iter(tasks)
    pending: dict[concurrent.futures.Future[Result], Task] = {}
    suspects: deque[Task] = deque()
    while True:
        while len(pending) < workers.in_flight and (task := next(waiting, None)) is not None:
            pending[workers.submit(analyse_task, task)] = task
        if not pending:
            return
        done, _ = concurrent.futures.wait(pending, return_when=concurrent.futures.FIRST_COMPLETED)
        for future in done:
            task = pending.pop(future)
            if isinstance(future.exception(), concurrent.futures.BrokenExecutor):
                suspects.append(task)
            else:
                yield _result_of(future, task)
        if suspects:
            suspects.extend(pending.values())
            pending.clear()
            workers.restart()
        while suspects:
            task = suspects.popleft()
            future = workers.submit(analyse_task, task)
            broken = isinstance(future.exception(), concurrent.futures.BrokenExecutor)
            yield _result_of(future, task)
            if broken:
                workers.restart()


def _result_of(future: concurrent.futures.Future[Result], task: Task) -> Result:
    error = future.exception()
    if error is None:
        return future.result()
    reason = f"the worker that analysed it ended: {error}"
    return {**dataclasses.asdict(task), **_time_of(Path(task.path), None), "error": reason, "sha256": None, "seconds": 0.0}

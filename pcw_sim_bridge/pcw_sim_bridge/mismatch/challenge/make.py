"""`mismatch challenge make`: draws cases, seals the answers, then records."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pcw_description.robot_file import save_robot

from ..errors import MismatchError
from .cases import Answer, CaseOrder, effects_of, order_cases, prepare_case, runs_of, world_of
from .sealed_answers import HASH_FILE, default_answers, open_sealed, seal
from .simulated_case import record
from .worker_processes import run_tasks

Progress = Callable[[str], None]


def make(
    folder: Path,
    count: int,
    seed: int,
    progress: Progress,
    answers: Path | None = None,
    workers: int = 2,
    **options: Any,
) -> list[str]:
    """Make a challenge, or go on with one that was interrupted: cases that are whole are kept.

    Args:
        folder: of the cases.
        count: number of cases; seed: of everything. Same seed, same cases.
        progress: is told what is being done.
        answers: the sealed file; default: beside `folder`.
        workers: number of processes.
        options: of `order_cases`: kinds, plants, durations.

    Returns:
        Names of the cases that could not be made.

    Raises:
        MismatchError: options that are not allowed, or other ones than those the folder was begun with.
    """
    orders = order_cases(count, seed, **options)
    header = {"seed": seed, "count": count, "options": {key: list(value) for key, value in sorted(options.items())}}
    sealed_file = answers or default_answers(folder)
    if sealed_file.resolve().is_relative_to(folder.resolve()):
        raise MismatchError(f"--answers {sealed_file} is inside {folder}; allowed: a file outside it")
    drafts = sealed_file.with_name(sealed_file.name + ".drafts")
    if drafts.exists() or not sealed_file.exists():
        if not drafts.exists():
            _check_new(folder)
        seal(sealed_file, header, _prepared(orders, header, drafts, progress, workers), folder)
        drafts.unlink(missing_ok=True)
    sealed = open_sealed(sealed_file, folder)
    if any(sealed[key] != value for key, value in header.items()):
        begun = {key: sealed[key] for key in header}
        raise MismatchError(f"{folder} was begun with {begun}; allowed: the same, or another --out; found {header}")
    todo = [a for a in sealed["cases"] if not (folder / a["case"]).exists()]
    made = sealed["count"] - len(todo)
    if made:
        progress(f"{made} recorded cases are kept")
    failed = []
    for number, done in enumerate(run_tasks(record_case, [(a["case"], (a, folder)) for a in todo], workers), 1):
        said = f"cannot be recorded: {done.error}" if done.error else f"recorded in {done.seconds:.1f} s"
        progress(f"{done.name} {said} ({made + number} of {sealed['count']})")
        failed += [done.name] if done.error else []
    return failed


def _check_new(folder: Path) -> None:
    if (folder / HASH_FILE).exists():
        raise MismatchError(f"{folder} holds cases whose answers are elsewhere; allowed: --answers FILE, or a new --out")


def _prepared(
    orders: Sequence[CaseOrder], header: dict[str, Any], drafts: Path, progress: Progress, workers: int
) -> list[Answer]:
    """Draw every case; what is drawn is kept in `drafts` until the answers are sealed."""
    found: dict[str, Answer] = {}
    if drafts.exists():
        lines = drafts.read_text(encoding="utf-8").split("\n")[:-1]  # a line without its end is no whole draft
        if not lines or json.loads(lines[0]) != header:
            raise MismatchError(f"{drafts} was begun with {lines[0] if lines else 'nothing'}; allowed: {json.dumps(header)}, "
                                "or remove it")
        found = {answer["case"]: answer for answer in map(json.loads, lines[1:])}
        drafts.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
        progress(f"{len(found)} drawn cases are kept")
    else:
        drafts.parent.mkdir(parents=True, exist_ok=True)
        drafts.write_text(json.dumps(header) + "\n", encoding="utf-8")
    tasks = [(order.name, (order,)) for order in orders if order.name not in found]
    with drafts.open("a", encoding="utf-8") as file:
        for done in run_tasks(prepare_case, tasks, workers):
            if done.error:
                raise MismatchError(f"{done.name} cannot be drawn: {done.error}")
            file.write(json.dumps(done.result) + "\n")
            file.flush()
            found[done.name] = done.result
            progress(f"{done.name} drawn in {done.seconds:.1f} s ({len(found)} of {len(orders)})")
    # As they will be read back: a mapping of the file and one that never was in it are the same bytes.
    return [json.loads(json.dumps(found[order.name])) for order in orders]


def record_case(answer: Answer, folder: Path) -> None:
    """Write the folder of a case: the robot as its user describes it, and the recordings. It appears whole."""
    part = folder / f".{answer['case']}.part"
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    world, effects = world_of(answer), effects_of(answer)
    save_robot(world.nominal, part / "robot.yaml")
    for run in runs_of(answer):
        path = part / run.path
        path.parent.mkdir(parents=True, exist_ok=True)
        record(world, run, effects if run.active else (), path)
    part.rename(folder / answer["case"])

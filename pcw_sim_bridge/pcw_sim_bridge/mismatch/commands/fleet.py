"""`mismatch fleet`: many recordings of many robots, and what became of each robot over time."""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any

from ..errors import MismatchError
from .analyze import remapped_topics


def add_parser(commands: Any) -> None:
    """Add the command line of `fleet`."""
    parser = commands.add_parser(
        "fleet",
        help="analyse many recordings and say what appeared when",
        description="Analyse every recording by itself, in parallel, and say for each robot what appeared when and how it "
        "wears. DIR/results.jsonl grows by a line per recording; what is in it is not analysed again, so that a run can be "
        "interrupted, and later recordings be added. Exit 0 when it ran; 2 on bad input, or when no recording could be used.",
        epilog="example: mismatch fleet logs --robot 'amr_*:=thesis' --out fleet_report --workers 2",
    )
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAGS", help="recordings, or folders with recordings in them")
    parser.add_argument(
        "--robot", required=True, action="append", metavar="[PATTERN:=]DESCRIPTION",
        help="description of all recordings, or of those in a folder whose name PATTERN (* and ?) fits: the folder is then "
        "the robot's name. Repeatable, the first that fits counts",
    )
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder of the results; earlier ones count")
    parser.add_argument("--workers", type=int, metavar="N", help="processes on this machine (default: one per core)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="Dask cluster to use instead, e.g. tcp://host:8786")
    parser.add_argument("--topic", action="append", default=[], metavar="NAME:=TOPIC", help="as for analyze")
    parser.add_argument("--seed", type=int, default=0, help="of the surrogates (default 0)")
    parser.add_argument("--quiet", action="store_true", help="no progress on standard error")
    parser.set_defaults(run=run, interrupted="what is done is kept in results.jsonl; the same command goes on from there")


def run(options: argparse.Namespace) -> int:
    """Analyse what is not done, then write fleet.json and fleet.html and print the sentences."""
    from ..fleet.fleet import FleetResults, FleetRobots, analyse_all, find_tasks
    from ..fleet.fleet_report import write_fleet_report
    from ..fleet.fleet_trends import histories
    from ..fleet.fleet_workers import DaskWorkers, LocalWorkers

    if options.workers is not None and options.workers < 1:
        raise MismatchError(f"--workers {options.workers} is not allowed; allowed: 1 and above")
    if options.scheduler is not None and options.workers is not None:
        raise MismatchError("--workers with --scheduler is not allowed; a cluster has its own workers")
    tasks = find_tasks(options.bags, FleetRobots.read(options.robot), remapped_topics(options.topic), options.seed)
    progress = FleetProgress(len(tasks), options.quiet)
    results = FleetResults(options.out)
    try:
        missing = (task for task in tasks if not progress.kept(results.holds(task)))
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        workers = DaskWorkers(options.scheduler) if options.scheduler else LocalWorkers(options.workers or cores)
        with workers:
            for result in analyse_all(missing, workers):
                results.add(result)
                progress.done(result)
        robots = histories(results, {task.robot: task.description_sha256 for task in tasks})
    finally:
        results.close()
    if progress.failures == len(tasks):
        raise MismatchError(f"none of the {len(tasks)} recordings could be analysed; the last one: {progress.last_failure}")
    page = write_fleet_report(robots, options.out)
    print(page)
    for robot in robots:
        print(f"{robot.name}: {len(robot.times)} recordings")
        for sentence in robot.sentences():
            print(f"  {sentence}")
    return 0


class FleetProgress:
    """Counts recordings, and tells after each how fast it goes and how long it will take."""

    def __init__(self, total: int, quiet: bool) -> None:
        self.total, self._quiet, self._begun = total, quiet, time.monotonic()
        self.skipped = self.analysed = self.failures = 0
        self.last_failure = ""

    def kept(self, known: bool) -> bool:
        """Count a recording that was found done, and return whether it was."""
        self.skipped += known
        return known

    def done(self, result: dict[str, Any]) -> None:
        """Count a recording that is done now."""
        self.analysed += 1
        if result["error"] is not None:
            self.failures += 1
            self.last_failure = f"{result['path']}: {result['error']}"
            self._tell(f"not analysed: {self.last_failure}")
        elapsed = time.monotonic() - self._begun
        rate = self.analysed / elapsed
        count = self.skipped + self.analysed
        left = (self.total - count) / rate
        said = f"{count} of {self.total} recordings"
        if self.skipped:
            said += f" ({self.skipped} done before)"
        self._tell(f"{said}, {60.0 * rate:.3g} a minute, {in_words(left)} left: {Path(result['path']).name}")

    def _tell(self, message: str) -> None:
        if not self._quiet:
            print(f"[{time.monotonic() - self._begun:6.1f} s] {message}", file=sys.stderr, flush=True)


def in_words(seconds: float) -> str:
    """Return a duration as people say it: "40 s", "12 min", "3.5 h"."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"

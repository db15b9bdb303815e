"""`mismatch challenge make|run|score`: the proof of the analyser on cases with concealed effects."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..errors import MismatchError


def add_parser(commands: Any) -> None:
    """Add the command line of `challenge`."""
    parser = commands.add_parser(
        "challenge",
        help="try the analyser on cases with concealed effects",
        description="Make cases with concealed effects and sealed answers, analyse them blindly, and score the reports.",
        epilog="example: mismatch challenge make --out runs/challenge --cases 400 --seed 20250601; "
        "mismatch challenge run runs/challenge; "
        "mismatch challenge score runs/challenge --answers runs/challenge.answers.json",
    )
    steps = parser.add_subparsers(dest="step", required=True, metavar="STEP")
    _add_make(steps)
    _add_run(steps)
    _add_score(steps)


def _add_make(steps: Any) -> None:
    make = steps.add_parser("make", help="draw cases and record them; goes on where it was interrupted")
    make.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for the cases")
    make.add_argument("--cases", required=True, type=int, metavar="N", help="how many")
    make.add_argument("--seed", required=True, type=int, metavar="S", help="of everything; same seed, same cases")
    make.add_argument("--answers", type=Path, metavar="FILE", help="the sealed answers (default: DIR.answers.json)")
    make.add_argument("--kinds", metavar="KIND,...", help="only none, single, pair, outside, masked (default: all)")
    make.add_argument("--plants", metavar="PLANT,...", help="only reduced, pybullet, mujoco (default: all)")
    make.add_argument("--durations", nargs=2, type=float, metavar=("LOW", "HIGH"), help="of a recording (default: 30 60) [s]")
    _add_common(make)
    make.set_defaults(run=_make, interrupted="what is whole is kept; the same command goes on")


def _add_run(steps: Any) -> None:
    run_ = steps.add_parser("run", help="analyse the cases; goes on where it was interrupted")
    run_.add_argument("folder", type=Path, metavar="DIR", help="folder of the cases")
    run_.add_argument("--out", type=Path, metavar="REPORTS", help="folder for the reports (default: DIR/reports)")
    run_.add_argument("--baselines", action="store_true", help="other people's methods on the same cases, too")
    _add_common(run_)
    run_.set_defaults(run=_run, interrupted="whole reports are kept; the same command goes on")


def _add_score(steps: Any) -> None:
    score = steps.add_parser("score", help="compare the reports with the answers")
    score.add_argument("folders", nargs="+", type=Path, metavar="DIR", help="folder of the cases; several count together")
    score.add_argument("--answers", required=True, nargs="+", type=Path, metavar="FILE", help="the sealed answers of each")
    score.add_argument(
        "--reports", nargs="+", type=Path, metavar="REPORTS", help="folder of the reports of each (default: DIR/reports)"
    )
    score.add_argument("--markdown", type=Path, metavar="FILE", help="write the figures as a page, misses and all")
    score.add_argument("--quiet", action="store_true", help="no progress on standard error")
    score.set_defaults(run=_score, interrupted="nothing was written")


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--workers", type=int, default=2, metavar="N", help="processes (default 2)")
    parser.add_argument("--quiet", action="store_true", help="no progress on standard error")


def _progress(options: argparse.Namespace) -> Callable[[str], None]:
    begun = time.monotonic()

    def told(message: str) -> None:
        if not options.quiet:
            print(f"[{time.monotonic() - begun:7.1f} s] {message}", file=sys.stderr, flush=True)

    return told


def _check_workers(options: argparse.Namespace) -> None:
    if options.workers < 1:
        raise MismatchError(f"--workers {options.workers} is not allowed; allowed: 1 and more")


def _make(options: argparse.Namespace) -> int:
    from ..challenge.make import make

    _check_workers(options)
    drawn: dict[str, Any] = {}
    for name in ("kinds", "plants"):
        given = getattr(options, name)
        if given is not None:
            drawn[name] = tuple(given.split(","))
    if options.durations is not None:
        drawn["durations"] = tuple(options.durations)
    failed = make(
        options.out, options.cases, options.seed, _progress(options), options.answers, options.workers, **drawn
    )
    print(options.out)
    return _told(failed, options.cases, "made")


def _run(options: argparse.Namespace) -> int:
    from ..challenge.run import case_folders, run

    _check_workers(options)
    failed = run(options.folder, _progress(options), options.out, options.workers, options.baselines)
    reports = options.out or options.folder / "reports"
    print(reports)
    return _told(failed, len(case_folders(options.folder)), "analysed")


def _told(failed: list[str], count: int, done: str) -> int:
    print(f"{count - len(failed)} of {count} cases {done}" + (f"; not {', '.join(failed)}" if failed else ""))
    return 0


def _score(options: argparse.Namespace) -> int:
    from ..challenge.score import CaseSet, score
    from ..challenge.score_page import page, text

    folders, reports = options.folders, options.reports or [None] * len(options.folders)
    for option, given in (("--answers", options.answers), ("--reports", reports)):
        if len(given) != len(folders):
            raise MismatchError(f"{option} has {len(given)} entries for {len(folders)} DIR; allowed: one for each")
    sets = [CaseSet(*entry) for entry in zip(folders, options.answers, reports, strict=True)]
    scored = score(sets, _progress(options))
    if options.markdown is not None:
        options.markdown.parent.mkdir(parents=True, exist_ok=True)
        options.markdown.write_text(page(scored), encoding="utf-8")
    print(text(scored))
    return 0

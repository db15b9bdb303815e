"""`mismatch challenge run`: analyses every case as `mismatch analyze` would, with nothing but what stands in its folder."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pcw_description.robot_file import load_robot

from ..analysis import analyse
from ..errors import MismatchError
from ..report.report import report_json
from ..subjects.load_subject import load_subject
from .worker_processes import run_tasks

Progress = Callable[[str], None]
REPORT, USAGE, BASELINES = "report.json", "usage.json", "baselines.json"


def run(
    folder: Path, progress: Progress, reports: Path | None = None, workers: int = 2, baselines: bool = False
) -> list[str]:
    """Analyse all cases that have no report yet.

    Args:
        folder: of the cases.
        progress: is told what is being done.
        reports: where the reports go, one folder for each case; default: `reports` in `folder`.
        workers: number of processes.
        baselines: run those on the same cases too, after the analysis of each.

    Returns:
        Names of the cases that failed; the next run tries them again.

    Raises:
        MismatchError: no cases there, or no baselines in this installation, or not what they need.
    """
    if baselines:
        _baseline_function()  # before an analysis of minutes
    cases = case_folders(folder)
    if any(folder.glob(".case_*.part")):  # as `make` calls those that are not whole
        progress("not all cases are recorded yet, and the others are left out: `challenge make` is at work, or was ended")
    reports = reports or folder / "reports"
    todo = [case for case in cases if not _is_done(reports / case.name, baselines)]
    if len(todo) < len(cases):
        progress(f"{len(cases) - len(todo)} reports are kept")
    tasks = [(case.name, (case, reports / case.name, baselines)) for case in todo]
    failed = []
    for number, done in enumerate(run_tasks(analyse_case, tasks, workers), len(cases) - len(todo) + 1):
        if done.error:
            failed.append(done.name)
            said = f"failed: {done.error}"
        else:
            said = f"{done.result} ({done.seconds:.1f} s, {done.peak_bytes / 2**20:.0f} MiB)"
            _add_usage(reports / done.name, peak_bytes=done.peak_bytes)
        progress(f"{done.name} {said} ({number} of {len(cases)})")
    return failed


def case_folders(folder: Path) -> list[Path]:
    """Return the folders of the cases, in order.

    Raises:
        MismatchError: there is none.
    """
    cases = sorted(path.parent for path in folder.glob("case_*/robot.yaml"))
    if not cases:
        raise MismatchError(f"{folder} holds no case; allowed: a folder that `challenge make` wrote")
    return cases


def recordings_of(case: Path) -> tuple[list[Path], list[Path]]:
    """Return the recordings to learn from and those to prove it on."""
    return sorted((case / "recordings").iterdir()), sorted((case / "holdout").iterdir())


def analyse_case(case: Path, out: Path, baselines: bool) -> str:
    """Write the report of a case, which appears whole; returns its verdict and what it names."""
    if not (out / REPORT).exists():
        fit, holdout = recordings_of(case)
        begun, cpu = time.monotonic(), time.process_time()
        subject = load_subject(str(case / "robot.yaml"))
        findings = analyse(subject, fit, holdout, {}, 0, lambda message: None).findings
        usage = {"seconds": time.monotonic() - begun, "cpu_seconds": time.process_time() - cpu}
        part = out.with_name(f".{out.name}.part")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        (part / REPORT).write_text(report_json(findings), encoding="utf-8")
        (part / USAGE).write_text(json.dumps(usage), encoding="utf-8")
        shutil.rmtree(out, ignore_errors=True)
        part.rename(out)
    if baselines:
        _run_baselines(case, out)
    report = json.loads((out / REPORT).read_text(encoding="utf-8"))
    named = [f"{effect['name']} of {'+'.join(effect['target'])}" for effect in report["effects"]]
    return ", ".join([report["verdict"], *named])


def _run_baselines(case: Path, out: Path) -> None:
    fit, holdout = recordings_of(case)
    begun = time.monotonic()
    results = _baseline_function()(load_robot(case / "robot.yaml"), fit, holdout, _noise_floors(out))
    found = [{**dataclasses.asdict(r), "named": list(r.names)} for r in results]
    part = out / f"{BASELINES}.part"
    part.write_text(json.dumps({"baselines": found, "seconds": time.monotonic() - begun}, indent=1), encoding="utf-8")
    os.replace(part, out / BASELINES)


def _noise_floors(out: Path) -> dict[str, float]:
    """Noise of the channels by the analyser's report, to which others are held too."""
    report = json.loads((out / REPORT).read_text(encoding="utf-8"))
    return {channel["name"]: channel["noise_floor"] for channel in report["channels"]}


def _baseline_function() -> Callable[..., Sequence[Any]]:
    try:
        from ..baselines import require_packages, run_baselines
    except ImportError as error:
        raise MismatchError(f"--baselines: not in this installation ({error}); allowed: without --baselines") from None
    require_packages()
    return run_baselines


def _is_done(report: Path, baselines: bool) -> bool:
    return all((report / name).exists() for name in (REPORT, USAGE, *([BASELINES] if baselines else [])))


def _add_usage(report: Path, **values: float) -> None:
    usage = report / USAGE
    kept = json.loads(usage.read_text(encoding="utf-8"))
    if "peak_bytes" not in kept:  # a later run of the baselines alone is another matter
        part = report / f"{USAGE}.part"
        part.write_text(json.dumps({**kept, **values}), encoding="utf-8")
        os.replace(part, usage)

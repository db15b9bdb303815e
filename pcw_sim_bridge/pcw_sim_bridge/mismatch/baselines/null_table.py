"""How often each method names something on robots with nothing missing.

    python -m pcw_sim_bridge.mismatch.baselines.null_table --cases 40 --seed 1 --out pcw_sim_bridge/docs/baselines.md

Draws robots within the tolerances of shipped descriptions and drives each twice: along the excitation that tells effects
apart best, for every method to learn from, and between random goals, to be judged by. The table replaces whatever follows
the mark in the file.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from pcw_control.excitation import make_excitation
from pcw_description.errors import PcwError
from pcw_description.robot_description import FloatArray, RobotDescription
from pcw_description.robot_file import load_robot

from ...simulated_run import record_run
from ..analysis import analyse
from ..subjects.robot_subject import RobotSubject
from .baseline_result import BaselineResult
from .comparison_packages import require_packages
from .identified_robot import free_numbers, with_numbers
from .run_baselines import run_baselines

MARK = "<!-- what follows is written by pcw_sim_bridge.mismatch.baselines.null_table -->"
ROBOTS = ("thesis", "tidybot2", "xr4000")
ANALYSER = "mismatch analyze"
# A drawn number is at most this many tolerances off: one farther out is no healthy robot's.
FARTHEST = 2.0
CONFIDENCE = 1.96


@dataclasses.dataclass(frozen=True)
class NullCase:
    """One healthy robot and what every method says of it."""

    robot: str
    results: tuple[BaselineResult, ...]


def healthy_robot(robot: RobotDescription, rng: np.random.Generator) -> RobotDescription:
    """Return a robot whose numbers differ from the description as its tolerances allow."""
    values = {}
    for number in free_numbers(robot):
        if number.tolerance > 0.0:
            change = float(np.clip(rng.standard_normal(), -FARTHEST, FARTHEST)) * number.tolerance
            values[number.name] = float(np.clip(number.nominal + change, number.lower, number.upper))
    return with_numbers(robot, values)


def wilson_interval(count: int, total: int) -> tuple[float, float]:
    """Interval (95 %) of a rate of which `count` in `total` were seen.

    Raises:
        ValueError: no case, or more counts than cases.
    """
    if not 0 <= count <= total or total == 0:
        raise ValueError(f"count = {count} of total = {total} is not allowed; allowed: 0 <= count <= total, total > 0")
    rate, z2 = count / total, CONFIDENCE**2
    centre = (rate + z2 / (2 * total)) / (1 + z2 / total)
    half = CONFIDENCE * math.sqrt(rate * (1 - rate) / total + z2 / (4 * total**2)) / (1 + z2 / total)
    return max(centre - half, 0.0), min(centre + half, 1.0)


def run_case(
    robot_name: str, seed: int, duration: float, identification_seconds: float, with_analyser: bool, folder: Path
) -> NullCase:
    """Record a healthy robot twice and run everything on it."""
    rng = np.random.default_rng(seed)
    nominal = load_robot(robot_name)
    robot = healthy_robot(nominal, rng)
    paths = [folder / f"{seed}_{part}" for part in ("fit", "holdout")]
    for path, kind in zip(paths, ("identification", "random_goals"), strict=True):
        excitation = make_excitation(kind, nominal, duration, int(rng.integers(2**31)))
        record_run(robot, excitation.twist, excitation.duration, int(rng.integers(2**31)), path, controlled_as=nominal)
    own = [_analysed(nominal, paths, seed)] if with_analyser else []
    return NullCase(robot_name, (*own, *run_baselines(nominal, paths[:1], paths[1:], None, seed, identification_seconds)))


def _analysed(nominal: RobotDescription, paths: Sequence[Path], seed: int) -> BaselineResult:
    begun = time.monotonic()
    findings = analyse(RobotSubject(nominal), paths[:1], paths[1:], {}, seed, lambda message: None).findings
    return BaselineResult(
        ANALYSER,
        tuple(f"{effect.name}/{'+'.join(effect.target)}" for effect in findings.effects),
        findings.fit.inverse_nrmse if findings.fit else None,
        findings.fit.gap_closed if findings.fit else None,
        time.monotonic() - begun,
    )


def table(cases: Sequence[NullCase]) -> str:
    """Return the table of the cases, one row per method."""
    lines = [
        "| method | cases | names something | 95 % interval | names per case, median (most) | held-out error, median | "
        "worse held out | time, median |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(result.name for case in cases for result in case.results):
        results = [result for case in cases for result in case.results if result.name == name]
        ran = [result for result in results if result.inverse_nrmse is not None]
        if not ran:
            lines.append(f"| {name} | 0 of {len(results)} | | | | | | {results[0].remark} |")
            continue
        named = sum(bool(result.names) for result in ran)
        low, high = wilson_interval(named, len(ran))
        counts = [len(result.names) for result in ran]
        errors = np.array([result.inverse_nrmse for result in ran])
        worse = sum(after > before for before, after in errors)
        lines.append(
            f"| {name} | {len(ran)} | {named} ({100 * named / len(ran):.0f} %) | {100 * low:.0f} to {100 * high:.0f} % | "
            f"{np.median(counts):.0f} ({max(counts)}) | {_pair(errors)} | {worse} | "
            f"{np.median([result.seconds for result in ran]):.1f} s |"
        )
    return "\n".join(lines) + "\n"


def _pair(errors: FloatArray) -> str:
    before, after = np.median(errors, axis=0)
    return f"{before:.4f} -> {after:.4f}"


def write(path: Path, cases: Sequence[NullCase], how: str) -> None:
    """Put the table below the mark of a file, which may not be there yet."""
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    path.write_text(f"{text.partition(MARK)[0]}{MARK}\n\n{how}\n\n{table(cases)}", encoding="utf-8")


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    main_parser = argparse.ArgumentParser(prog="null_table", description="What each method names where nothing is missing.")
    main_parser.add_argument("--cases", type=int, default=40, help="healthy robots to draw (default 40)")
    main_parser.add_argument("--seed", type=int, default=0, help="of the first case; the others follow (default 0)")
    main_parser.add_argument("--duration", type=float, default=20.0, help="of a recording [s] (default 20)")
    main_parser.add_argument("--identified", type=int, default=0, metavar="N",
                             help="cases that mujoco.sysid runs on, which takes minutes each (default 0)")
    main_parser.add_argument("--analyser", action="store_true", help="run `mismatch analyze` on the same cases, too")
    main_parser.add_argument("--out", type=Path, required=True, metavar="FILE.md", help="file whose table is replaced")
    return main_parser


def main(arguments: Sequence[str] | None = None, say: Callable[[str], None] = print) -> int:
    """Run the command line and return the exit code; after every case the file holds all that were done."""
    options = parser().parse_args(arguments)
    cases: list[NullCase] = []
    try:
        require_packages()
        for index in range(options.cases):
            robot, seed = ROBOTS[index % len(ROBOTS)], options.seed + index
            with tempfile.TemporaryDirectory() as folder:
                seconds = 60.0 if index < options.identified else 0.0
                case = run_case(robot, seed, options.duration, seconds, options.analyser, Path(folder))
            cases.append(case)
            say(f"{robot}, seed {seed}: " + "; ".join(f"{r.name}: {len(r.names)}" for r in case.results))
            how = (
                f"{len(cases)} healthy robots ({', '.join(ROBOTS)} in turn, seeds {options.seed} to {seed}), each number "
                f"drawn within its tolerance, `reduced` plant, recordings of {options.duration:g} s: `identification` to "
                "learn from, `random_goals` held out."
            )
            write(options.out, cases, how)
    except PcwError as error:
        print(f"null_table: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

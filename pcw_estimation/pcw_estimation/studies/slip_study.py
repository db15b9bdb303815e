"""Run every study of slip and write the page of the documentation, figures included.

python -m pcw_estimation.studies.slip_study [--out docs] [--quick]
"""

from __future__ import annotations

import argparse
import platform
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ..slip_verdict import COMMON_SLIP, Verdict
from .encoder_study import (
    METHODS,
    Outcome,
    Scenario,
    drawn_scenario,
    episode,
    fig_4_1,
    healthy_alarms,
    judge,
    run,
)
from .fault_study import KINDS, diagnose
from .imu_study import AllSlip, all_wheels_slip, follow, found_after, hundred_metres
from .line_plot import Line, svg

HEALTHY_SECONDS = 20.0


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return ["| " + " | ".join(line) + " |" for line in [header, ["---"] * len(header), *rows]]


def figure_4_1(folder: Path) -> list[str]:
    """Fig. 4.1: one wheel slips."""
    driven = fig_4_1()
    rows, found = [], {}
    for method in METHODS:
        found[method] = run(method, driven)
        one = episode(driven, found[method], 2, 1.5, 3.5)
        ever = np.asarray(found[method].flagged.any(axis=(0, 2)))
        flagged = [name for name, was in zip(driven.robot.caster_names, ever) if was]
        rows.append(
            [method, ", ".join(flagged), f"{1e3 * one.onset_delay:.0f} ms", f"{1e3 * one.end_delay:.0f} ms"]
        )
    lines = [
        Line(name, driven.stamp, found["consensus"].slip[:, i, 0]) for i, name in enumerate(driven.robot.caster_names)
    ]
    text = svg("Fig. 4.1: slip found by the consensus", "time [s]", "longitudinal slip [m/s]", lines, [(1.5, 3.5)])
    (folder / "slip_fig_4_1.svg").write_text(text, encoding="utf-8")
    return [
        "## One wheel slips (Fig. 4.1)", "",
        "The thesis robot drives at 0.5 m/s; its third wheel, `rear_left`, runs 0.15 m/s ahead from 1.5 to 3.5 s (grey).", "",
        "![slip of each wheel](slip_fig_4_1.svg)", "",
        *_table(("method", "casters flagged", "onset found after", "end found after"), rows), "",
    ]  # fmt: skip


# Kinds of drawn scenarios: how often in which axes, and whether to and fro, see `drawn_scenario`.
SCENARIOS = (
    ("rolling axis", (1.0, 0.0, 0.0), False),
    ("rolling 60 %, steering 20 %, both 20 %", (0.6, 0.2, 0.2), False),
    ("both axes", (0.0, 0.0, 1.0), False),
    ("both axes, to and fro", (0.0, 0.0, 1.0), True),
)


def scenarios(count: int) -> list[str]:
    """Drawn scenarios, by both methods."""
    lines = [
        "## Drawn scenarios", "",
        f"{count} robots of 3 to 6 casters, drawn in size and place, drive as drawn, with reversals; 1 to n - 2 casters",
        "slip by 0.05 to 0.5 m/s, together or one after the other. The robots differ from their files by their tolerances;",
        "encoders have the noise and counts of the thesis robot, speeds come from the drive or from differences of angles. A",
        "scenario counts as exact when the casters flagged in all of it are those that slip: none missed, none too many, none",
        "too early. The procedure of the thesis looks at one axis at a time, and slip in one axis turns the fitted twist so",
        "that the other axis seems to slip as well: it flags too many.", "",
    ]  # fmt: skip
    rows = []
    for label, share, to_and_fro in SCENARIOS:
        drawn = [drawn_scenario(seed, share, to_and_fro) for seed in range(count)]
        for method in METHODS:
            outcomes = [judge(scenario, run(method, scenario.driven)) for scenario in drawn]
            rows.append([label, method, *_shares(outcomes)])
            if method == "consensus":
                by_size = _by_size(drawn, outcomes)
        lines += [f"Exact by size, {label}, consensus: {by_size}.", ""]
    header = ("slip in", "method", "exact", "a caster missed", "a caster too many", "time in which it cannot know")
    return [*lines, *_table(header, rows), ""]


def _shares(outcomes: Sequence[Outcome]) -> list[str]:
    return [
        f"{100 * np.mean([o.exact for o in outcomes]):.1f} %",
        f"{100 * np.mean([o.missed > 0 for o in outcomes]):.1f} %",
        f"{100 * np.mean([o.wrong > 0 for o in outcomes]):.1f} %",
        f"{100 * np.mean([o.said_it_cannot_know for o in outcomes]):.1f} %",
    ]


def _by_size(drawn: Sequence[Scenario], outcomes: Sequence[Outcome]) -> str:
    found = []
    for n in range(3, 7):
        of_size = [o.exact for s, o in zip(drawn, outcomes) if s.driven.robot.n == n]
        if of_size:
            found.append(f"{n} casters {sum(of_size)} of {len(of_size)}")
    return ", ".join(found)


def false_alarms(count: int) -> list[str]:
    """Healthy robots."""
    rows = []
    for method in METHODS:
        alarms = sum(healthy_alarms(100_000 + seed, method, HEALTHY_SECONDS) for seed in range(count))
        hours = count * HEALTHY_SECONDS / 3600.0
        rows.append([method, f"{hours:.2f} h", str(alarms), f"{alarms / hours:.2f}"])
    return [
        "## False alarms", "",
        f"{count} healthy robots, drawn likewise, on drives of {HEALTHY_SECONDS:g} s, with the thresholds that follow from",
        "their files.", "", *_table(("method", "driven", "alarms", "alarms per hour"), rows), "",
    ]  # fmt: skip


def figure_4_2(count: int, folder: Path) -> list[str]:
    """Fig. 4.2: all wheels slip."""
    cases = [all_wheels_slip(seed) for seed in range(count)]
    delays = np.array([found_after(case) for case in cases])
    in_time = (delays >= 0.0) & (delays <= 0.05)
    rows = []
    kinds = ("the same share of speed", "the same velocity", "each a share of its own")
    for kind, label in enumerate(kinds):
        shares = np.mean([_encoders_alone(case) for case in cases[kind::3]], axis=0)
        rows.append(
            [
                label, f"{100 * np.mean(in_time[kind::3]):.1f} %", f"{1e3 * np.median(delays[kind::3]):.0f} ms",
                *(f"{100 * share:.0f} %" for share in shares),
            ]
        )  # fmt: skip
    case = cases[0]
    followed, alone = follow(case.driven), run("consensus", case.driven)
    stamp = case.driven.stamp
    lines = [
        Line("truth", stamp, np.hypot(case.driven.twist[:, 0], case.driven.twist[:, 1])),
        Line("encoders alone", stamp, np.hypot(alone.twist[:, 0], alone.twist[:, 1])),
        Line("with IMU", stamp, np.hypot(followed.twist[:, 0], followed.twist[:, 1])),
    ]
    text = svg("Fig. 4.2: all wheels slip", "time [s]", "speed [m/s]", lines, [(case.start, case.end)])
    (folder / "slip_fig_4_2.svg").write_text(text, encoding="utf-8")
    return [
        "## All wheels slip (Fig. 4.2)", "",
        f"{count} drives of the thesis robot, IMU at 1 kHz, on which all wheels slip for 0.5 to 1.5 s, by 15 to 60 % of",
        f"their speed. `imu_slip` flags every wheel within 50 ms in {100 * np.mean(in_time):.1f} % of the drives",
        f"({int(np.sum(delays < 0.0))} too early, {int(np.sum(np.isinf(delays)))} never).", "",
        "The encoders alone, in shares of the slipping time: they cannot know which wheels slip; or all wheels are named,",
        "rightly, by their forks that still trail; or some only; or they agree. Wheels that slip alike do agree: slip that",
        "is a motion of the whole robot is motion to every encoder, and only an onset faster than traction could move the",
        "robot gives it away. So where they agree the detector says that no wheel slips against another, and that",
        f"{COMMON_SLIP}; that nothing slips it never says. The",
        "last columns are the share in which it says in one way or the other that it cannot know, and that of the drives",
        "in which it doubts at least once that any wheel rolls.",
        "", "![speed of the robot](slip_fig_4_2.svg)", "",
        *_table(
            (
                "wheels slip by", "IMU within 50 ms", "median delay", "encoders: cannot know which", "all", "some",
                "agree, common slip not known", "either cannot know", "doubt, ever",
            ),
            rows,
        ), "",
    ]  # fmt: skip


def _encoders_alone(case: AllSlip) -> tuple[float, float, float, float, float, float]:
    """Return in which share of the slipping time encoders say: cannot know; all; some slip; agree; the first or the last of
    these; and 1 if ever the first.
    """
    found = run("consensus", case.driven)
    during = (case.driven.stamp >= case.start) & (case.driven.stamp < case.end)
    verdict, every = found.verdict[during], np.all(np.any(found.flagged[during], axis=2), axis=1)
    unknown, slip = verdict == int(Verdict.CANNOT_KNOW), verdict == int(Verdict.SLIP)
    agree = verdict == int(Verdict.CONSISTENT)
    return (
        float(np.mean(unknown)), float(np.mean(slip & every)), float(np.mean(slip & ~every)), float(np.mean(agree)),
        float(np.mean(unknown | agree)), float(np.any(unknown)),
    )  # fmt: skip


def long_drives(count: int) -> list[str]:
    """Odometry on 100 m."""
    drives = [hundred_metres(seed) for seed in range(count)]
    plain, fused = np.array([d.plain for d in drives]), np.array([d.fused for d in drives])
    nees = np.array([d.nees for d in drives])
    low, high = nees_bounds(count)
    rows = [
        ["plain pseudo-inverse odometry", f"{np.median(plain):.2f} m", f"{plain.max():.2f} m"],
        ["fusion", f"{np.median(fused):.2f} m", f"{fused.max():.2f} m"],
    ]
    return [
        "## 100 m over slippery patches", "",
        f"{count} drawn drives of 100 m, of which {100 * np.mean([d.on_patches for d in drives]):.0f} % is slippery, in",
        "patches of 0.3 to 1.5 m on which the wheels run ahead or lag by 10 to 60 %, on the longer ones all at once. The IMU",
        "has the noise of the robot file, and biases, scale, place and clock off by its tolerances, as is the slope of the",
        "floor; two seconds of standstill come first.", "",
        *_table(("odometry", "median error at the end", "largest"), rows), "",
        f"Ratio of the medians: {np.median(fused) / np.median(plain):.3f}; median of the ratios:",
        f"{np.median(fused / plain):.3f}. Mean NEES of the pose at the end (3 degrees of freedom): {nees.mean():.2f}; with a",
        f"right covariance 95 % of such means lie between {low:.2f} and {high:.2f}. Largest single one: {nees.max():.1f}.", "",
    ]  # fmt: skip


def nees_bounds(count: int) -> tuple[float, float]:
    """Return between which numbers the mean of `count` NEES of 3 degrees of freedom lies with 95 %, by Wilson and Hilferty."""
    freedom = 3 * count
    spread = 2.0 / (9.0 * freedom)
    low, high = (freedom * (1.0 - spread + z * np.sqrt(spread)) ** 3 / count for z in (-1.96, 1.96))
    return float(low), float(high)


def faults(count: int) -> list[str]:
    """Faults of joints."""
    rows = []
    for kind in KINDS:
        found = [diagnose(seed, kind) for seed in range(count)]
        delays = [d.delay for d in found if np.isfinite(d.delay)]
        four = [d.right for d in found if d.n >= 4]
        rows.append(
            [
                kind, f"{100 * np.mean([d.right for d in found]):.0f} %", f"{100 * np.mean(four):.0f} %",
                f"{100 * np.mean([d.wrong > 0 for d in found]):.0f} %", f"{np.median(delays):.1f} s" if delays else "",
            ]
        )  # fmt: skip
    return [
        "## Faults", "",
        f"{count} drawn robots and drives of 15 s for each fault, of a drawn joint, from 3 s on (a swapped sign from the",
        "start).", "",
        *_table(("fault", "named right", "with 4 casters and more", "another joint named", "median delay"), rows), "",
    ]  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the studies and write the page."""
    parser = argparse.ArgumentParser(prog="slip_study", description="Run the studies of slip; write slip.md with figures.")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder to write to (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="a tenth of the seeds, to see that it works")
    options = parser.parse_args(arguments)
    if not options.out.is_dir():
        parser.error(f"argument --out: {options.out} is not a folder")
    part = 10 if options.quick else 1
    studies: tuple[Callable[[], list[str]], ...] = (
        lambda: figure_4_1(options.out),
        lambda: scenarios(500 // part),
        lambda: false_alarms(900 // part),
        lambda: figure_4_2(200 // part, options.out),
        lambda: long_drives(50 // part),
        lambda: faults(40 // part),
    )
    page = [
        "# Slip and faults: what the estimators find", "",
        "Written by `python -m pcw_estimation.studies.slip_study`; every number and figure here is its own.",
        "Kinematic drives from seeds: wheels roll and slip as asked.", "",
    ]  # fmt: skip
    started = time.perf_counter()
    for study in studies:
        section = study()
        page += section
        print("\n".join(section), flush=True)
    print(f"{time.perf_counter() - started:.0f} s, Python {platform.python_version()}")
    (options.out / "slip.md").write_text("\n".join(page).rstrip() + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

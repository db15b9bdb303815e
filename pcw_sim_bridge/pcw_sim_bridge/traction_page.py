"""Writes the page and the plots of `traction_study` from the data in its folder."""

from __future__ import annotations

import csv
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pcw_description.robot_file import load_robot
from pcw_estimation.studies.line_plot import MOST_POINTS, Line, svg

from . import guided_circle, slip_ratio_runs, split_friction

Rows = Sequence[Mapping[str, str]]
CASE_TITLES = {
    "split": "one wheel on mu = 0.1",
    "uniform": "all wheels on mu = 0.1",
    "off_centre": "all wheels on mu = 0.1, load off the centre",
}
BASELINE = "pseudo-inverse"
# Bars: relative to the pseudo-inverse and absolute [m/s], beyond the limit.
BARS = {
    "SCFC": (0.05, 0.040), "QP + SCFC": (0.02, 0.020),
    "SCFC, paced": (0.05, 0.040), "QP + SCFC, paced": (0.02, 0.020),
}  # fmt: skip
BELOW_BAR, SPREAD_BAR = 0.8, 0.5
RATIO_BARS = {"truth": 0.01}
OBSERVER_BAR, REACHED_BAR = 0.02, 0.15
STEP_BARS = {"friction_optimal": 300.0, "friction_optimal_slip_constraint": 300.0}
OTHER_STEP_BAR = 60.0

_SLIP_TEXT = """\
A quintic with 1 m/s at its fastest, in a random direction and from random headings; payload and drive friction that the
controller does not know; encoder noise; torques 2 ms late. Slip is the RMS over the whole run of the wheel that slips
most, along and across together, of the truth. Slip feedback is from encoders only. *Beyond* the limit the
pseudo-inverse asks the worst wheel for more than it holds (split: 1.5 to 2.4 times, off centre: 1.4 to 1.8, uniform: 1
to 1.1, as there the others are nearly at their limits too, and *far beyond* 1.5 to 2.4); *below* it, for 0.6 to 0.85 of
what it holds. TLA as
printed (clip), the weighted pseudo-inverse and the QP are told friction and load under every wheel, wrong by up to 10
%; SCFC is told nothing.

The thesis shows fig. 5.9 without a number: slip detected without SCFC, zero with it. What the figure cannot show: below
the limit there is only creep to reduce. On uniform ground nearly all of it is needed to make the force at all: a wheel
of this tyre that uses the part u of its hold creeps at the slip ratio lambda_p (1 - sqrt(1 - u^2)) / u, which for the
whole quintic is 13 to 20 mm/s RMS at 0.6 to 0.85, and 27 mm/s at 1, less what the force spends on the wheels' own inertia
and what the tyre's relaxation holds back. What SCFC takes away there is what the wheels push against each other. Where the
pseudo-inverse does not run away far, creep is more than a twentieth of its slip, and no way to share forces meets that bar.
Slip that all wheels have in common is not seen by encoders.

What is left is to ask for less. A *paced* method drives the same path at the pace at which half of the friction that it is
told of carries it (`plan_within_friction`; what the node does with a `goal_pose`). It takes longer: `time` is the duration
relative to the pseudo-inverse's, the fastest speed falls by the same factor. SCFC alone, told nothing, is not paced.
"""
_GUIDED_TEXT = """\
A push of 20 N turns round once in six seconds. Spread is how far the rolling speeds are from those of one rigid motion,
RMS. Energy is that of the push on the robot's true motion (on a jack: on the guided motion). It is injected where the
lowest value is below zero, or where more is given back than the moving body had: the last column is above zero then.

The thesis shows figs. 5.11 and 5.12 without a number. On good ground there is hardly any unevenness to take away,
because the tyres hold the wheels together far more stiffly than any control at this delay may; where a wheel has little
grip, or all have none, the internal forces do it.
"""
_COMMON_TEXT = """\
All wheels on mu = 0.1, asked to speed up to 1 m/s and to stop at twice what the ground gives, torques 2 ms late. No way
to share forces can help here. `slip_ratio_limit` keeps the slip ratios at 0.8 of the critical one (0.08), with the slip
known from the truth: the robot then speeds up and brakes at what the ground gives.
"""
_COST_TEXT = """\
CPU time of the thread, four casters, measurements drawn anew for every step. To be run on a machine that does nothing else.
"""
_RATIO_TEXT = """\
One wheel with its share of the robot, on the catalogue's Kiencke curves, held from 1 m/s on, driving, and from 5 m/s to 1
m/s, braking; set-points are 0.2 and the ground's own critical slip ratio. RMS from 0.15 s on. Beyond the peak the force grows
with slip no more, so that the velocity can only be integrated from it: a mass that is wrong by a part makes a velocity
that is wrong by that part of its change. So the mass has to be known by then, and the observer learns it while the wheel
grips: it speeds up from rest with half of the friction that is believed to be there. *Reached* is the first time within 5 %
of the set-point, a stricter bar than that of the RMS error with an observer; where not all runs get there, the number of
those that do stands beside the time.

The thesis shows figs. 5.14 and 5.16 without a number, set-point 0.2; it models driving only.
"""


def read(path: Path) -> Rows:
    """Return the rows of a CSV; none where there is no file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _met(value: object) -> str:
    return "met" if value else "**not met**"


def _slip_tables(data: Rows) -> list[str]:
    """Return the tables of slip, with all levels side by side; a method is compared with the same seeds of the baseline."""
    Level = dict[str, dict[str, tuple[float, float]]]
    found: dict[tuple[str, ...], Level] = defaultdict(lambda: defaultdict(dict))
    for row in data:
        key = row["robot"], row["plant"], row["case"], row["level"]
        found[key][row["method"]][row["seed"]] = 1e3 * float(row["slip"]), float(row["took"])
    lines = []
    for robot, plant, case in dict.fromkeys(key[:3] for key in found):
        levels = {name: found[robot, plant, case, name] for name in split_friction.LEVELS[case]
                  if (robot, plant, case, name) in found}  # fmt: skip
        runs = ", ".join(f"{max(map(len, level.values()))} runs {name} the limit" for name, level in levels.items())
        lines += [
            f"### {CASE_TITLES[case]}: {robot}, {plant} plant", "", f"Median [10 %, 90 %] of {runs}, in mm/s.", "",
            "A method with another number of runs says so, and is compared with the same ones of the pseudo-inverse.", "",
            "| method | " + "".join(f"{name} the limit | of the pseudo-inverse | time | " for name in levels) + "bars |",
            "|---|" + "---:|---:|---:|" * len(levels) + "---|",
        ]  # fmt: skip
        for name in split_friction.METHODS:
            cells, verdicts = [], []
            for label, level in levels.items():
                if name not in level or BASELINE not in level:
                    cells += ["", "", ""]
                    continue
                seeds = level[name].keys() & level[BASELINE].keys()
                if not seeds:
                    cells += ["", "", ""]
                    continue
                values, took = np.array([level[name][seed] for seed in seeds]).T
                base, base_took = np.array([level[BASELINE][seed] for seed in seeds]).T
                runs_made = "" if len(seeds) == max(map(len, level.values())) else f", {len(seeds)} runs"
                ratio = float(np.median(values) / np.median(base))
                low, high = np.percentile(values, [10, 90])
                longer = float(np.median(took) / np.median(base_took))
                cells += [f"{np.median(values):.1f} [{low:.1f}, {high:.1f}]{runs_made}", f"{ratio:.3f}", f"x {longer:.2f}"]
                verdicts += _slip_verdicts(name, label, float(np.median(values)), ratio)
            if any(cells):
                lines.append(f"| {name} | {' | '.join(cells)} | {'; '.join(verdicts)} |")
        lines.append("")
    return lines


def _slip_verdicts(method: str, level: str, slip: float, ratio: float) -> list[str]:
    """Return what the bars say of a median slip [mm/s] and its ratio to the pseudo-inverse."""
    if method not in BARS:
        return []
    if level == "below":
        return [f"20 % less below: {_met(ratio <= BELOW_BAR)}"]
    relative, absolute = BARS[method]
    where = "" if level == "beyond" else f"{level} "
    return [
        f"{where}<= {relative:g} x: {_met(ratio <= relative)}",
        f"{where}<= {1e3 * absolute:.0f} mm/s: {_met(slip <= 1e3 * absolute)}",
    ]


def _guided_table(data: Rows) -> list[str]:
    found: dict[tuple[str, str, str], dict[str, list[Mapping[str, str]]]] = defaultdict(lambda: defaultdict(list))
    for row in data:
        found[row["robot"], row["plant"], row["ground"]][row["seed"]].append(row)
    lines = [
        "| robot, plant | ground | runs | without [mm/s] | with [mm/s] | ratio | bar 0.5 | energy put in [J] | lowest [J] | "
        "given back beyond what was held [J] |",
        "|---|---|---:|---:|---:|---:|---|---:|---:|---:|",
    ]
    names = {"on": "its own", "slippery": "one wheel on mu = 0.1", "off": "on a jack"}
    for (robot, plant, place), seeds in found.items():
        held = [row for rows in seeds.values() for row in rows if row["slip_held"] == "with"]
        free = [row for rows in seeds.values() for row in rows if row["slip_held"] == "without"]
        if not held or not free:
            continue
        spread = [1e3 * float(np.median([float(row["spread"]) for row in rows])) for rows in (free, held)]
        ratio = spread[1] / spread[0]
        lines.append(
            f"| {robot}, {plant} | {names[place]} | {len(held)} | {spread[0]:.2f} | {spread[1]:.2f} | {ratio:.3f} | "
            f"{_met(ratio <= SPREAD_BAR)} | {np.median([float(row['energy']) for row in held]):.1f} | "
            f"{min(float(row['least_energy']) for row in held):.4f} | {max(float(row['given_back']) for row in held):.4f} |"
        )
    return [*lines, ""]


def _ratio_table(data: Rows) -> list[str]:
    found: dict[tuple[str, ...], list[Mapping[str, str]]] = defaultdict(list)
    for row in data:
        found[row["robot"], row["ground"], row["set_point"], row["motion"], row["source"]].append(row)
    lines = [
        "| robot | ground | set-point | motion | velocity from | runs | reached by [s], worst | RMS error, median | "
        "RMS error, worst | bars |",
        "|---|---|---:|---|---|---:|---:|---:|---:|---|",
    ]
    for (robot, place, set_point, motion, source), rows in found.items():
        times = [float(row["reached"]) for row in rows]
        reached, within = max(times), [time for time in times if time < math.inf]
        said = f"{reached:.3f}" if reached < math.inf else f"{max(within, default=math.inf):.3f}, {len(within)} runs"
        rms = np.array([float(row["rms"]) for row in rows])
        bar = RATIO_BARS.get(source, OBSERVER_BAR)
        verdict = f"{_met(reached <= REACHED_BAR)}, {_met(float(np.median(rms)) <= bar)} ({bar:g})"
        lines.append(
            f"| {robot} | {place} | {float(set_point):.2f} | {motion} | {source} | {len(rows)} | {said} | "
            f"{np.median(rms):.4f} | {rms.max():.4f} | {verdict} |"
        )
    return [*lines, ""]


def _common_table(data: Rows) -> list[str]:
    lines = [
        "| robot | controller | slip [mm/s] | largest slip ratio | speeds up at [m/s^2] | brakes at [m/s^2] |",
        "|---|---|---:|---:|---:|---:|",
    ]
    for row in data:
        lines.append(
            f"| {row['robot']} | {row['controller']} | {1e3 * float(row['slip']):.1f} | {float(row['worst_ratio']):.3f} | "
            f"{float(row['acceleration']):.2f} | {float(row['braking']):.2f} |"
        )
    return [*lines, ""]


def cost_table(data: Rows) -> list[str]:
    """Return the table of what a control step of each controller costs."""
    lines = ["| robot | controller | median [us] | p99 [us] | bar [us] | |", "|---|---|---:|---:|---:|---|"]
    for row in data:
        bar = STEP_BARS.get(row["controller"], OTHER_STEP_BAR)
        met = _met(float(row["p99"]) <= bar)
        lines.append(f"| {row['robot']} | {row['controller']} | {row['median']} | {row['p99']} | {bar:g} | {met} |")
    return [*lines, ""]


def _write_series(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            writer.writerow([f"{value:.5g}" for value in row])


def _plot(out: Path, name: str, title: str, unit: str, time: np.ndarray, series: Mapping[str, np.ndarray]) -> list[str]:
    """Write a plot and its data, thinned to what the plot shows; returns the lines that show it."""
    chosen = np.linspace(0, len(time) - 1, min(len(time), MOST_POINTS)).astype(int)
    time, series = time[chosen], {label: values[chosen] for label, values in series.items()}
    _write_series(out / f"{name}.csv", {"time": time, **series})
    lines = [Line(label, time, values) for label, values in series.items()]
    (out / f"{name}.svg").write_text(svg(title, "time [s]", unit, lines))
    return [f"![{title}]({name}.svg)", ""]


def figures(out: Path, robot_name: str = "thesis", seed: int = 0) -> dict[str, list[str]]:
    """Write the plots of one run each; returns the lines that show them, by part."""
    robot = load_robot(robot_name)
    manoeuvre = split_friction.draw_manoeuvre(robot, "split", "beyond", seed)
    shown: dict[str, list[str]] = {}
    slips, time = {}, np.zeros(0)
    for name in (BASELINE, "SCFC", "QP + SCFC"):
        run = split_friction.drive(robot, manoeuvre, split_friction.METHODS[name], seed)
        time, slips[name] = run.time, 1e3 * np.linalg.norm(run.slip, axis=2).max(axis=1)
    held = {name: values for name, values in slips.items() if name != BASELINE}
    shown["slip"] = _plot(
        out, "traction_fig_5_9", "Slip of the worst wheel, one wheel on mu = 0.1 (fig. 5.9)", "slip [mm/s]", time, slips
    ) + _plot(out, "traction_fig_5_9_held", "The same, with slip held", "slip [mm/s]", time, held)
    guided = []
    for ground, number in (("off", "5.11"), ("slippery", "5.12")):
        for label, controller in guided_circle.CONTROLLERS.items():
            run, _ = guided_circle.guided_run(robot, seed, controller, ground)
            speeds = run.joint_velocity[:, :, 0] * robot.wheel_radius
            series = {name: speeds[:, i] for i, name in enumerate(robot.caster_names)}
            where = "on a jack" if ground == "off" else "one wheel on mu = 0.1"
            title = f"Rolling speeds, {where}, {label} slip held (fig. {number})"
            name = f"traction_fig_{number.replace('.', '_')}_{label}"
            guided += _plot(out, name, title, "rolling speed [m/s]", run.time, series)
    shown["guided"] = guided
    ratio = []
    for source, number in (("truth", "5.14"), ("observer, 1 %", "5.16")):
        series = {}
        for place in slip_ratio_runs.GROUNDS:
            held_run = slip_ratio_runs.hold_slip_ratio(
                robot, place, slip_ratio_runs.SET_POINT, slip_ratio_runs.START["drive"], slip_ratio_runs.SOURCES[source], seed
            )
            time, series[place] = held_run.time, held_run.slip_ratio
        name = f"traction_fig_{number.replace('.', '_')}"
        ratio += _plot(out, name, f"Slip ratio, velocity from: {source} (fig. {number})", "slip ratio [1]", time, series)
    shown["ratio"] = ratio
    return shown


def write_page(out: Path) -> None:
    """Write `traction.md` and its plots."""
    shown = figures(out)
    slip, guided = read(out / "traction_slip.csv"), read(out / "traction_guided.csv")
    ratio, cost = read(out / "traction_ratio.csv"), read(out / "traction_cost.csv")
    lines = [
        "# What keeps traction", "",
        "Written by `python -m pcw_sim_bridge.traction_study`; every number comes from the CSV files beside this page.", "",
        "## Slip, by how the force is shared", "",
        _SLIP_TEXT, *shown["slip"], *_slip_tables(slip),
        "## Force-guided along a circle", "",
        _GUIDED_TEXT, *_guided_table(guided), *shown["guided"],
        "## Slip that all wheels have in common", "",
        _COMMON_TEXT, *_common_table(read(out / "traction_common.csv")),
        "## Slip ratio", "",
        _RATIO_TEXT, *_ratio_table(ratio), *shown["ratio"],
    ]  # fmt: skip
    if cost:
        lines += ["## Time of a control step", "", _COST_TEXT, *cost_table(cost)]
    (out / "traction.md").write_text("\n".join(lines).rstrip() + "\n")

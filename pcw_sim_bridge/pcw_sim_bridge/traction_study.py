"""All figures of what keeps traction, as data, plots and one page: `pcw_control/docs/traction.md`.

    python -m pcw_sim_bridge.traction_study [--out pcw_control/docs] [--seeds 50] [--parts slip guided common ratio cost]

Each part writes its data as CSV; the page and the plots are made of whatever data is in the folder, so that parts can
be run one by one. `slip` compares ways to share the force (`split_friction`), `guided` is a push along a circle
(`guided_circle`), `common` asks all wheels for too much at once (`common_slip`), `ratio` holds slip ratios
(`slip_ratio_runs`), `cost` measures the step of every controller.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from pcw_control.controller_interface import ControllerMeasurement, TwistReference
from pcw_control.controllers import CONTROLLERS, make_controller
from pcw_description.errors import PcwError
from pcw_description.robot_file import load_robot

from . import common_slip, guided_circle, slip_ratio_runs, split_friction
from .traction_page import cost_table, read, write_page

SLIP_COLUMNS = ("robot", "plant", "case", "level", "seed", "method", "slip", "took")
PARTS = ("slip", "guided", "common", "ratio", "cost")
Rows = Iterable[tuple[object, ...]]


def slip_rows(
    robot_name: str, seeds: int, plants: Sequence[str], cases: Sequence[str], methods: Sequence[str],
    known: set[tuple[str, str, str, str, str]],
) -> Rows:
    """Yield the slip of methods on every manoeuvre that is not known yet, by plant, case, level, seed and method."""
    robot = load_robot(robot_name)
    for plant in plants:
        for case in cases:
            for level in split_friction.LEVELS[case]:
                for seed in range(seeds):
                    left = [name for name in methods if (plant, case, level, str(seed), name) not in known]
                    found = split_friction.slip_by_method(robot, case, level, seed, plant, left) if left else {}
                    for name, (slip, took) in found.items():
                        yield robot_name, plant, case, level, seed, name, f"{slip:.6f}", f"{took:.3f}"


def cost_rows(robot_name: str, cycles: int = 3000) -> Rows:
    """Yield the time of a step of every controller: CPU time of this thread [us], so that other programs do not count."""
    robot = load_robot(robot_name)
    rng = np.random.default_rng(0)
    for name in CONTROLLERS:
        controller = make_controller(name, robot)
        state, spent = controller.initial_state(), []
        for cycle in range(cycles + 500):
            measured = ControllerMeasurement(
                rng.normal(0.0, 1.0, (robot.n, 2)), rng.normal(0.0, 1.0, (robot.n, 2)), np.zeros(3),
                slip=rng.normal(0.0, 0.1, (robot.n, 2)), friction=rng.uniform(0.1, 0.8, robot.n),
                external_wrench=rng.normal(0.0, 10.0, 3),
            )  # fmt: skip
            started = time.thread_time_ns()
            state, _ = controller.step(state, measured, TwistReference(np.array([0.5, 0.1, 0.2])), 0.002)
            if cycle >= 500:
                spent.append((time.thread_time_ns() - started) * 1e-3)
        yield robot_name, name, f"{np.median(spent):.1f}", f"{np.percentile(spent, 99):.1f}"


def write_csv(path: Path, header: Sequence[str], rows: Rows, keep: Callable[[dict[str, str]], bool]) -> None:
    """Write rows as they come, after the older ones that are to be kept; a run that is stopped leaves what it had."""
    older: list[dict[str, str]] = []
    if path.exists():
        with path.open(newline="") as file:
            older = [row for row in csv.DictReader(file) if keep(row)]
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows([row[name] for name in header] for row in older)
        for row in rows:
            writer.writerow(row)
            file.flush()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study; exit 0, or 2 for bad input."""
    parser = argparse.ArgumentParser(prog="traction_study", description=str(__doc__).partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("pcw_control/docs"), help="folder of data, plots and page")
    parser.add_argument("--seeds", type=int, default=50, help="runs per case")
    parser.add_argument("--robot", default="thesis", help="a shipped robot or a .yaml file")
    parser.add_argument("--plants", nargs="+", default=["reduced", "pybullet"], help="plants to run on")
    parser.add_argument("--cases", nargs="+", default=list(split_friction.CASES), choices=split_friction.CASES)
    parser.add_argument(
        "--methods", nargs="+", default=list(split_friction.METHODS), choices=split_friction.METHODS, metavar="METHOD",
        help="of the part slip: " + "; ".join(split_friction.METHODS),
    )
    parser.add_argument("--more", action="store_true", help="of the part slip: keep the runs that are there, add what misses")
    parser.add_argument("--parts", nargs="*", default=list(PARTS), choices=PARTS)
    options = parser.parse_args(arguments)
    if options.seeds < 1:
        parser.error("--seeds has to be at least 1")
    out, robot, plants = options.out, options.robot, options.plants
    out.mkdir(parents=True, exist_ok=True)
    try:
        if "slip" in options.parts:
            path = out / "traction_slip.csv"
            known = {
                (row["plant"], row["case"], row["level"], row["seed"], row["method"])
                for row in read(path) if options.more and row["robot"] == robot
            }  # fmt: skip
            write_csv(
                path, SLIP_COLUMNS,
                slip_rows(robot, options.seeds, plants, options.cases, options.methods, known),
                lambda row: options.more or not (
                    row["robot"] == robot and row["plant"] in plants and row["case"] in options.cases
                    and row["method"] in options.methods
                ),
            )  # fmt: skip
        if "guided" in options.parts:
            write_csv(
                out / "traction_guided.csv", guided_circle.COLUMNS, guided_circle.rows(robot, options.seeds, plants),
                lambda row: not (row["robot"] == robot and row["plant"] in plants),
            )  # fmt: skip
        if "common" in options.parts:
            write_csv(out / "traction_common.csv", common_slip.COLUMNS, common_slip.rows(), lambda row: False)
        if "ratio" in options.parts:
            write_csv(
                out / "traction_ratio.csv", slip_ratio_runs.COLUMNS, slip_ratio_runs.rows(robot, options.seeds),
                lambda row: row["robot"] != robot,
            )  # fmt: skip
        if "cost" in options.parts:
            write_csv(
                out / "traction_cost.csv", ("robot", "controller", "median", "p99"), cost_rows(robot),
                lambda row: row["robot"] != robot,
            )  # fmt: skip
            print("\n".join(cost_table(read(out / "traction_cost.csv"))), flush=True)
        write_page(out)
    except PcwError as error:
        print(f"traction_study: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

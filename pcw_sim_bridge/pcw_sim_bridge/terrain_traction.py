"""Traction control that finds out about the ground itself, against the same controller told the truth.

    python -m pcw_sim_bridge.terrain_traction [--seeds 20] [--plants reduced pybullet] [--out pcw_terrain/docs]

The manoeuvres are those of `split_friction`: a quintic that speeds up and brakes at 1 m/s at its fastest while one wheel, or
all, stand on mu = 0.1. The controller is QP + SCFC. It is told friction in four ways:

* truth: the peak friction under every wheel as it is;
* terrain: what observer, terrain estimators and slip slopes find from joints and motor torques while it drives
  (`pcw_terrain.shared_friction`); they believe in the robot file's ground, which is another one;
* file: the ground of the robot file under every wheel, wrong as it is;
* within 10 %: the truth with an error, as in `split_friction`.

It writes terrain_traction.csv, one row per run, after those that are there and not run again, and of all of them
terrain_traction.md; with --seeds 0 only the latter.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pcw_control.controller_interface import ControllerMeasurement
from pcw_control.controllers import make_controller
from pcw_description.errors import PcwError
from pcw_description.robot_description import STEER, FloatArray, RobotDescription
from pcw_description.robot_file import load_robot
from pcw_estimation.robot_sliding_mode_observer import RobotSlidingModeObserver
from pcw_estimation.sliding_mode_observer import SlidingModeParameters
from pcw_estimation.slip_estimate import JointMeasurement
from pcw_terrain.observed_ground import ObservedGround, ObservedGroundOutput
from pcw_terrain.robot_terrain import RobotReading
from pcw_terrain.shared_friction import SharedFriction

from .closed_loop import run_closed_loop
from .sensors import JointReading
from .split_friction import AFTER, CASES, LEVELS, Manoeuvre, draw_manoeuvre, slip_of_worst_wheel
from .traction_study import write_csv

CONTROLLER = "friction_optimal_slip_constraint"
TOLD = ("truth", "terrain", "file", "within 10 %")
COLUMNS = ("robot", "plant", "case", "level", "seed", "told", "slip")
BAR = 1.3  # of terrain against truth, on split friction


class TerrainInTheLoop:
    """Everything between the joints and what the controller is told, as the nodes slip_observer and terrain do it.

    Args:
        robot: as it is believed to be.
        measured: "speed" or "angle", of the observer.
    """

    def __init__(self, robot: RobotDescription, measured: str = "speed") -> None:
        self.robot = robot
        self._observer = RobotSlidingModeObserver(robot, SlidingModeParameters(measured=measured))
        self._ground = ObservedGround(robot)
        self._observed, self._state = self._observer.initial_state(), self._ground.initial_state()
        self.found: ObservedGroundOutput | None = None

    def observe(self, reading: JointReading, dt: float) -> None:
        """Take one reading of the joints, `dt` [s] after the one before."""
        measurement = JointMeasurement(reading.position, reading.velocity, reading.effort)
        self._observed, found = self._observer.step(self._observed, measurement, dt)
        if not found.force_valid.all():
            return
        steer_angle = np.ascontiguousarray(reading.position[:, STEER])
        sensed = found.wheel_velocity + found.slip_velocity
        known = np.full(self.robot.n, bool(found.slip_valid.all()))
        wheels = RobotReading(sensed, found.slip_velocity, found.force, steer_angle, known)
        self._state, self.found = self._ground.step(self._state, wheels, dt)

    def friction(self) -> SharedFriction:
        """Return what to believe of the ground now."""
        return self._state.told

    def tell(self, measured: ControllerMeasurement) -> ControllerMeasurement:
        """Add it to what a controller is given."""
        found = self.friction()
        return dataclasses.replace(measured, friction=found.mu_p, critical_slip=found.lambda_p)


def true_friction(robot: RobotDescription, manoeuvre: Manoeuvre) -> FloatArray:
    """Return the peak friction coefficient that a manoeuvre has under each wheel (n,)."""
    mu = np.array([tyre.mu_p for tyre in robot.tyres])
    for effect in manoeuvre.robot.physics:
        if effect.name == "low_friction_patch":
            slippery = [name in effect.target for name in robot.caster_names]
            mu = np.where(slippery, mu * effect.parameters["factor"], mu)
    return mu


def slip_when_told(robot: RobotDescription, manoeuvre: Manoeuvre, told: str, seed: int, plant: str = "reduced") -> float:
    """Return the slip of the worst wheel, RMS over the run [m/s], of QP + SCFC that is told of friction in one way.

    Args:
        robot: as the controller believes it to be.
        manoeuvre: what is driven, on which ground.
        told: one of TOLD.
        seed: of the sensor noise.
        plant: name of the plant.
    """
    loop, truth = TerrainInTheLoop(robot), true_friction(robot, manoeuvre)

    def with_friction(friction: FloatArray, normal_force: FloatArray | None = None):  # type: ignore[no-untyped-def]
        return lambda measured: dataclasses.replace(measured, friction=friction, normal_force=normal_force)

    tell = {
        "truth": with_friction(truth), "within 10 %": with_friction(manoeuvre.friction, manoeuvre.normal_force),
        "terrain": loop.tell, "file": None,
    }[told]  # fmt: skip
    run = run_closed_loop(
        manoeuvre.robot, make_controller(CONTROLLER, robot), manoeuvre.trajectory.sample,
        manoeuvre.trajectory.duration + AFTER, plant, seed, manoeuvre.steer_angle, measure=tell,
        observe=loop.observe if told == "terrain" else None,
    )  # fmt: skip
    return slip_of_worst_wheel(run)


def rows(
    robot_name: str, seeds: range, plants: Sequence[str], cases: Sequence[str], levels: Sequence[str], told: Sequence[str]
) -> Iterator[tuple[str, ...]]:
    """Yield one row per run."""
    robot = load_robot(robot_name)
    for plant in plants:
        for case in cases:
            for level in levels:
                for seed in seeds:
                    manoeuvre = draw_manoeuvre(robot, case, level, seed)
                    for way in told:
                        slip = slip_when_told(robot, manoeuvre, way, seed, plant)
                        row = (robot_name, plant, case, level, str(seed), way, f"{slip:.6f}")
                        print(",".join(row), flush=True)
                        yield row


def table(data: Sequence[dict[str, str]]) -> list[str]:
    """Return the lines of the table of all runs."""
    found: dict[tuple[str, ...], dict[str, dict[str, float]]] = {}
    for row in data:
        key = (row["robot"], row["plant"], row["case"], row["level"])
        found.setdefault(key, {}).setdefault(row["told"], {})[row["seed"]] = float(row["slip"])
    lines = [
        "| robot, plant | ground | level | runs | " + " | ".join(f"{way} [mm/s]" for way in TOLD)
        + " | terrain / truth, of the medians | median of the runs' | 90 % of the runs | file / truth | bar 1.3 |",
        "|---|---|---|---:|" + (len(TOLD) + 5) * "---:|",
    ]
    for (robot, plant, case, level), ways in found.items():
        seeds = sorted(set.intersection(*(set(values) for values in ways.values())), key=int)
        slip = {way: np.array([ways[way][seed] for seed in seeds]) for way in ways}
        medians = {way: float(np.median(values)) for way, values in slip.items()}
        ratio = medians["terrain"] / medians["truth"]
        each = slip["terrain"] / slip["truth"]
        bar = ("met" if ratio <= BAR else "**not met**") if case == "split" else "-"
        cells = [f"{1e3 * medians[way]:.1f}" if way in medians else "-" for way in TOLD]
        of_file = f"{medians['file'] / medians['truth']:.2f}" if "file" in medians else "-"
        lines.append(
            f"| {robot}, {plant} | {case} | {level} | {len(seeds)} | " + " | ".join(cells)
            + f" | {ratio:.2f} | {np.median(each):.2f} | {np.quantile(each, 0.9):.2f} | {of_file} | {bar} |"
        )
    return lines


def page(data: Sequence[dict[str, str]]) -> str:
    """Return the text of terrain_traction.md."""
    return "\n".join([
        "# Traction without knowing the ground",
        "",
        "Written by `python -m pcw_sim_bridge.terrain_traction` from [terrain_traction.csv](terrain_traction.csv), which has",
        "the seeds; nothing here is typed in.",
        "",
        "The manoeuvres are those of [traction](../../pcw_control/docs/traction.md): a quintic with 1 m/s at its fastest in a",
        "random direction, payload and drive friction unknown, encoder noise, torques 2 ms late. *split*: one wheel on",
        "mu = 0.1, the others on the robot file's ground; *uniform*, *off_centre*: all on mu = 0.1. Slip is the RMS over the",
        "run of the wheel that slips most, of the truth, median of the runs. The controller is QP + SCFC. *truth*: it is told",
        "the friction under every wheel; *terrain*: it is told what observer, terrain estimators and slip slopes find from",
        "joints and torques as it drives, beginning with the ground of the robot file; *file*: the ground of the robot file.",
        "",
        *table(data),
        "",
    ])  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study; exit 0, or 2 for bad input."""
    parser = argparse.ArgumentParser(prog="terrain_traction", description=str(__doc__).partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("pcw_terrain/docs"), help="folder (default: %(default)s)")
    parser.add_argument("--seeds", type=int, default=20, help="runs per case (default: %(default)s)")
    parser.add_argument("--first-seed", type=int, default=0, help="(default: %(default)s)")
    parser.add_argument("--robot", default="thesis", help="a shipped robot or a .yaml file (default: %(default)s)")
    parser.add_argument("--plants", nargs="+", default=["reduced", "pybullet"], help="plants (default: %(default)s)")
    parser.add_argument("--cases", nargs="+", default=["split"], choices=CASES, help="grounds (default: %(default)s)")
    parser.add_argument("--levels", nargs="+", default=list(LEVELS["split"]), choices=LEVELS["split"], help="(default: all)")
    parser.add_argument("--told", nargs="+", default=list(TOLD), choices=TOLD, help="(default: all)")
    options = parser.parse_args(arguments)
    if options.seeds < 0 or not {"truth", "terrain"} <= set(options.told):
        parser.error("--seeds has to be at least 0, and --told to hold truth and terrain")
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "terrain_traction.csv"
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    anew = {"robot": [options.robot], "plant": options.plants, "case": options.cases, "level": options.levels}

    def keep(row: dict[str, str]) -> bool:
        return not seeds or any(row[name] not in values for name, values in anew.items())

    try:
        run = rows(options.robot, seeds, options.plants, options.cases, options.levels, options.told)
        write_csv(path, COLUMNS, run, keep)
    except PcwError as error:
        print(f"terrain_traction: {error}", file=sys.stderr)
        return 2
    with path.open(newline="") as file:
        text = page(list(csv.DictReader(file)))
    (options.out / "terrain_traction.md").write_text(text, encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())

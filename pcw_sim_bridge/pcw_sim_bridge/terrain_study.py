"""Terrain from joint angles and torques alone, and slip on purpose, on whole robots.

    python -m pcw_sim_bridge.terrain_study [--seeds 10] [--plants reduced pybullet] [--out pcw_terrain/docs/terrain_robot.md]

A robot follows a straight line at 0.3 m/s by computed torque; then one caster after another is made to slip through the
internal forces (`pcw_terrain.active_identification`). Nobody knows the ground: controller, observer and identification believe
in the robot file's, the plant has another one. Forces and, in the version by angle, all speeds come from the sliding-mode
observer and the angles.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pcw_control.computed_torque import ComputedTorque
from pcw_control.controller_interface import ControllerMeasurement
from pcw_control.quintic_trajectory import TrajectoryPoint
from pcw_control.torque_limits import TorqueLimits, limit_torque
from pcw_description.odometry import OdometryParameters, update
from pcw_description.odometry import initial_state as initial_odometry
from pcw_description.robot_description import STEER, ContactDescription, FloatArray, RobotDescription
from pcw_description.robot_file import load_robot
from pcw_estimation.slip_estimate import JointMeasurement
from pcw_terrain.active_identification import Phase

from .ground_test import GroundTest, GroundTestParameters, shifted
from .plants.factory import make_plant
from .sensors import JointReading
from .simulated_robot import JointCommand, SimulatedRobot

SPEED, UNDER_WAY, REQUESTED = 0.3, 1.0, 1.5  # [m/s], until it moves steadily [s], when slip is asked for [s]
LONGEST, AFTERWARDS = 8.0, 0.4  # of a run, and after the last test [s]
ROBOT, OTHER_ROBOTS = "thesis", ("xr4000", "flow_base")


def on_ground(robot: RobotDescription, mu_p: float, lambda_p: float) -> RobotDescription:
    """Return the robot on another ground, the same in all directions; the tyre stays."""

    def changed(contact: ContactDescription) -> ContactDescription:
        lateral = dataclasses.replace(contact.lateral, mu_p=mu_p, lambda_p=lambda_p)
        return dataclasses.replace(contact, mu_p=mu_p, lambda_p=lambda_p, lateral=lateral)

    return dataclasses.replace(robot, contact=changed(robot.contact))


@dataclasses.dataclass(frozen=True)
class ActiveRun:
    """What one run found.

    Attributes:
        mu_p, lambda_p: per caster (n,) [1]; NaN where nothing was found.
        covariance: of their logarithms (n, 2, 2).
        valid: per caster (n,).
        duration: from the request to the end of the last test [s].
        refusal: why it ended early, in words; "" if it did not.
        along, across: greatest distance of base_link from where it should be, on its line and beside it [m].
        yaw: greatest turn [rad].
        predicted_path: what had been predicted of one test [m].
        trace: time [s], errors of the pose along, across [m] and in yaw [rad], and the caster under test or -1, from the
            request on (T, 5).
    """

    mu_p: FloatArray
    lambda_p: FloatArray
    covariance: FloatArray
    valid: np.ndarray
    duration: float
    refusal: str
    along: float
    across: float
    yaw: float
    predicted_path: float
    trace: FloatArray = dataclasses.field(default_factory=lambda: np.zeros((0, 5)), repr=False)


def line(now: float, heading: float) -> TrajectoryPoint:
    """Return the point at a time [s] of a straight line that is begun at rest."""
    s = min(now / UNDER_WAY, 1.0)
    way = SPEED * (UNDER_WAY * (s**3 - 0.5 * s**4) + max(now - UNDER_WAY, 0.0))
    velocity, acceleration = SPEED * s * s * (3.0 - 2.0 * s), SPEED * 6.0 * s * (1.0 - s) / UNDER_WAY
    direction = np.array([np.cos(heading), np.sin(heading), 0.0])
    return TrajectoryPoint(way * direction, velocity * direction, acceleration * direction)


def active_run(
    real: RobotDescription, believed: RobotDescription, plant: str, seed: int, measured: str = "angle", heading: float = 0.0
) -> ActiveRun:
    """Drive a robot along a line and identify the ground under every caster.

    Args:
        real: as it really is.
        believed: what everything that computes believes.
        plant: name of the plant.
        seed: of the sensor noise.
        measured: "angle", joint angles and torques alone, or "speed".
        heading: of the line [rad]; the casters begin turned that way.
    """
    n = believed.n
    inner = make_plant(plant, real)
    inner.reset(steer_angle=np.full(n, heading))
    simulated = SimulatedRobot(inner, seed)
    controller = ComputedTorque(believed)
    control = controller.initial_state()
    limits, torque, asked = TorqueLimits.of_robot(believed), np.zeros((n, 2)), np.zeros((n, 2))
    test = GroundTest(believed, GroundTestParameters(measured))
    state = test.initial_state()
    odometry, odometry_parameters = initial_odometry(), OdometryParameters()
    saturated, before, requested, ended, predicted = False, -1, False, 0.0, 0.0
    errors: list[FloatArray] = []
    while simulated.time_ns < LONGEST * 1e9:
        reading = list(simulated.advance())[-1].reading
        assert isinstance(reading, JointReading)  # the joints come last
        dt = (simulated.time_ns - before) * 1e-9 if before >= 0 else simulated.control_period
        before, now = simulated.time_ns, simulated.time_ns * 1e-9
        begins = not requested and now >= REQUESTED
        if begins:
            state, requested = test.request(state), True
        state, output = test.step(state, JointMeasurement(reading.position, reading.velocity, reading.effort), asked, dt)
        if begins:
            predicted = test.active.predict(reading.position[:, STEER], 0, output.normal_force).path
        odometry, _ = update(believed, odometry_parameters, shifted(odometry, output.missed), output.position, dt)
        seen = ControllerMeasurement(output.position, output.velocity, odometry.pose, saturated)
        point = line(now, heading)
        control, wanted = controller.step(control, seen, point, dt)
        asked = wanted.torque
        limited = limit_torque(limits, torque, asked + output.torque, reading.velocity, dt)
        torque, saturated = limited.torque, limited.saturated
        simulated.command(JointCommand(effort=torque))
        errors.append(np.array([now, *(simulated.plant.state().pose - point.pose), output.testing]))
        if requested and state.testing.phase in (Phase.DONE, Phase.REFUSED):
            ended = ended or now
            if now > ended + AFTERWARDS:
                break
    simulated.close()
    error = np.array(errors)
    error = error[error[:, 0] >= REQUESTED]
    error[:, 1:4] -= error[0, 1:4]
    c, s = np.cos(heading), np.sin(heading)
    along, across = c * error[:, 1] + s * error[:, 2], c * error[:, 2] - s * error[:, 1]
    error[:, 1], error[:, 2] = along, across
    ground = state.ground
    return ActiveRun(
        ground.mu_p, ground.lambda_p, ground.covariance, ground.valid,
        (ended or LONGEST) - REQUESTED, state.testing.refusal.value,
        float(np.abs(along).max()), float(np.abs(across).max()), float(np.abs(error[:, 3]).max()), predicted, error,
    )  # fmt: skip


def random_ground(seed: int) -> tuple[float, float]:
    """Return mu_p and lambda_p of a ground that nobody knows."""
    rng = np.random.default_rng([seed, 53])
    return float(rng.uniform(0.3, 0.8)), float(rng.uniform(0.06, 0.18))


def random_heading(seed: int) -> float:
    """Return a direction to drive in [rad]."""
    return float(np.random.default_rng([seed, 59]).uniform(-np.pi, np.pi))


def with_one_elsewhere(robot: RobotDescription, seed: int) -> tuple[RobotDescription, list[tuple[float, float]]]:
    """Return a robot one wheel of which stands on another ground, half as good to twice, and mu_p, lambda_p per caster."""
    rng = np.random.default_rng([seed, 61])
    ground, caster = random_ground(seed), int(rng.integers(robot.n))
    other = (float(min(ground[0] * 2.0 ** rng.uniform(-1.0, 1.0), 0.8)), float(rng.uniform(0.06, 0.18)))
    real = on_ground(robot, *ground).with_tyres(
        [robot.caster_names[caster]], lambda tyre: on_ground(dataclasses.replace(robot, contact=tyre), *other).contact
    )
    return real, [other if i == caster else ground for i in range(robot.n)]


@dataclasses.dataclass(frozen=True)
class ActiveSummary:
    """Many runs; errors are relative, of all casters of all runs that gave a valid estimate."""

    tests: int
    valid: int
    mu_median: float
    mu_worst: float
    lambda_median: float
    lambda_worst: float
    covered: tuple[float, float]
    slowest: float
    path_median: float
    path_worst: float
    yaw_worst: float
    predicted: float
    refusals: tuple[str, ...]


def summarise(grounds: Sequence[Sequence[tuple[float, float]]], runs: Sequence[ActiveRun]) -> ActiveSummary:
    """Return the figures of runs on these grounds, mu_p and lambda_p under each caster."""
    mu, critical, spread = [], [], []
    for ground, run in zip(grounds, runs, strict=True):
        for index in np.nonzero(run.valid)[0]:
            mu_p, lambda_p = ground[int(index)]
            mu.append(np.log(run.mu_p[index] / mu_p))
            critical.append(np.log(run.lambda_p[index] / lambda_p))
            spread.append(np.sqrt(np.diag(run.covariance[index])))
    error = np.abs(np.column_stack([mu, critical])) if mu else np.full((1, 2), np.nan)
    covered = (error <= 1.96 * np.array(spread)).mean(axis=0) if mu else np.full(2, np.nan)
    path = np.array([np.hypot(run.along, run.across) for run in runs])
    return ActiveSummary(
        sum(len(run.valid) for run in runs), len(mu), float(np.median(error[:, 0])), float(error[:, 0].max()),
        float(np.median(error[:, 1])), float(error[:, 1].max()), (float(covered[0]), float(covered[1])),
        max(run.duration for run in runs), float(np.median(path)), float(path.max()), max(run.yaw for run in runs),
        float(np.median([run.predicted_path for run in runs])), tuple(run.refusal for run in runs if run.refusal),
    )  # fmt: skip


def _rows(plants: Sequence[str]) -> list[tuple[str, str, str, bool]]:
    """Robot, plant, what is measured, and whether one wheel stands elsewhere."""
    rows = [(ROBOT, plant, measured, False) for plant in plants for measured in ("angle", "speed")]
    return rows + [(name, plants[0], "angle", False) for name in OTHER_ROBOTS] + [(ROBOT, plants[0], "angle", True)]


def document(plants: Sequence[str], seeds: range) -> str:
    """Return the text of terrain_robot.md."""
    parts = [
        "# Terrain of whole robots",
        "",
        f"Written by `python -m pcw_sim_bridge.terrain_study --seeds {len(seeds)} --first-seed {seeds.start} --plants "
        f"{' '.join(plants)}`; nothing here is typed in.",
        "",
        f"A robot follows a straight line at {SPEED:g} m/s in a direction drawn at random, its wheels turned that way, and is "
        "asked to identify the ground under every caster by letting one after the other slip. mu_p is drawn from 0.3 to 0.8 "
        "and lambda_p from 0.06 to 0.18; everything that computes believes in the robot file's, 0.8 and 0.1, at first. "
        "`angle`: joint angles and motor torques are all that observer and identification are given. Ground `one elsewhere`: "
        "one wheel stands on another one, half as good to twice. The path's error is that of base_link against its line, "
        "along and across together, from the request until after the last test.",
        "",
        "| robot | plant | ground | measured | tests | valid | mu_p: median error | worst | lambda_p: median | worst | 95 % "
        "intervals hold mu_p, lambda_p | slowest, all casters | path: median | worst | yaw, worst | path predicted, one test "
        "| ended early |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, plant, measured, split in _rows(plants):
        started, believed = time.perf_counter(), load_robot(name)
        grounds, runs = [], []
        for seed in seeds:
            real, ground = on_ground(believed, *random_ground(seed)), [random_ground(seed)] * believed.n
            if split:
                real, ground = with_one_elsewhere(believed, seed)
            grounds.append(ground)
            runs.append(active_run(real, believed, plant, seed, measured, random_heading(seed)))
        s = summarise(grounds, runs)
        ended = [f"{reason} ({s.refusals.count(reason)} runs)" for reason in sorted(set(s.refusals))]
        parts.append(
            f"| {name} | {plant} | {'one elsewhere' if split else 'one'} | {measured} | {s.tests} | {s.valid} | "
            f"{s.mu_median:.1%} | {s.mu_worst:.1%} | {s.lambda_median:.1%} | {s.lambda_worst:.1%} | {s.covered[0]:.0%}, "
            f"{s.covered[1]:.0%} | {s.slowest:.2f} s | {1e3 * s.path_median:.1f} mm | {1e3 * s.path_worst:.1f} mm | "
            f"{1e3 * s.yaw_worst:.1f} mrad | {1e3 * s.predicted:.1f} mm | {'; '.join(ended) or '-'} |"
        )
        print(parts[-1], f"({time.perf_counter() - started:.0f} s)", flush=True)
    parts += [
        "",
        "A test needs a motor that can take its wheel past the ground's hold: the drives of `tidybot2` and "
        "`dyros_pcv` cannot on "
        "good ground, and are refused there with that reason.",
        "",
    ]
    return "\n".join(parts)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study and write what it finds."""
    parser = argparse.ArgumentParser(prog="terrain_study", description="Identify the ground under whole robots.")
    parser.add_argument("--seeds", type=int, default=10, help="runs per plant (default: %(default)s)")
    parser.add_argument("--first-seed", type=int, default=0, help="(default: %(default)s)")
    parser.add_argument("--plants", nargs="+", default=["reduced", "pybullet"], help="plants (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("pcw_terrain/docs/terrain_robot.md"), help="file to write")
    options = parser.parse_args(arguments)
    if options.seeds < 1:
        parser.error(f"argument --seeds: {options.seeds} is not allowed; allowed: at least 1")
    if options.out.is_dir():
        parser.error(f"argument --out: {options.out} is a folder; allowed: the file to write")
    text = document(options.plants, range(options.first_seed, options.first_seed + options.seeds))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

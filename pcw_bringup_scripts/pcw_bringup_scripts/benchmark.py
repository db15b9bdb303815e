"""How fast this machine runs the parts that a control loop or a simulation waits for; measured, never asserted.

    ros2 run pcw_bringup_scripts benchmark [--robot ROBOT] [--repeats N] [--json FILE]

Every figure is that of the whole call as a user makes it from Python: arguments checked, results boxed. The run with a
controller holds everything that closes the loop: plant, read-out of its state, sensors with their noise, odometry, computed
torque and torque limits. Compiling is done before and told apart. The best of the repeats is what the code can do, the
median what it did here; the mark against the target goes by the best.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from pcw_control.computed_torque import ComputedTorque
from pcw_control.controller_interface import ControllerMeasurement, TwistReference
from pcw_control.torque_limits import TorqueLimits, limit_torque
from pcw_description.augmented_object_model import AugmentedObjectModel
from pcw_description.differential_kinematics import inverse_kinematics
from pcw_description.effects.registry import all_effects, read_physics
from pcw_description.errors import PcwError
from pcw_description.new_file import require_new_file
from pcw_description.odometry import OdometryParameters, update
from pcw_description.odometry import initial_state as initial_odometry
from pcw_description.robot_description import DRIVE, STEER, RobotDescription
from pcw_description.robot_file import load_robot
from pcw_estimation.imu_slip import ImuSlip
from pcw_estimation.robot_sliding_mode_observer import RobotSlidingModeObserver
from pcw_estimation.sliding_mode_observer import SlidingModeParameters
from pcw_estimation.slip_consensus import SlipConsensus
from pcw_estimation.slip_estimate import JointMeasurement
from pcw_sim_bridge.plants.factory import make_plant
from pcw_sim_bridge.plants.plant import Plant
from pcw_sim_bridge.sensors import JointReading
from pcw_sim_bridge.simulated_robot import JointCommand, SimulatedRobot
from pcw_terrain.robot_terrain import RobotReading, RobotTerrain
from pcw_terrain.slip_slope import SlipSlope
from pcw_terrain.terrain_estimator import TerrainEstimator, TerrainParameters, WheelReading

FORMAT = "pcw_benchmark/1"
STEP = 1e-3  # of the plants [s]
MICROSECONDS, REAL_TIME = "us", "x real time"
LIBRARIES = ("numpy", "scipy", "numba", "pybullet", "mujoco")
Prepare = Callable[[RobotDescription], Callable[[], float]]


@dataclasses.dataclass(frozen=True)
class Task:
    """One thing to measure.

    Attributes:
        name: what it is, as printed.
        unit: `MICROSECONDS` per call (less is better) or `REAL_TIME`, simulated per wall time (more is better).
        target: what it should reach; None where there is no target.
        prepare: makes the robot ready and returns a function that does the work once over and returns how much it was:
            the number of calls, or the simulated time [s].
    """

    name: str
    unit: str
    target: float | None
    prepare: Prepare


@dataclasses.dataclass(frozen=True)
class Result:
    """One figure.

    Attributes:
        name, unit, target: of the task.
        best, median: over the repeats; None where it could not be measured.
        first: time until the work had been done for the first time, compiling included [s].
        note: why there is no figure.
    """

    name: str
    unit: str
    target: float | None
    best: float | None = None
    median: float | None = None
    first: float = 0.0
    note: str = ""

    @property
    def reached(self) -> bool | None:
        """Whether the best reaches the target; None where there is no figure or no target."""
        if self.best is None or self.target is None:
            return None
        return self.best <= self.target if self.unit == MICROSECONDS else self.best >= self.target


def measure(task: Task, robot: RobotDescription, repeats: int) -> Result:
    """Run a task once to compile it, then `repeats` times; a task that cannot run says why."""
    started = time.perf_counter()
    try:
        work = task.prepare(robot)
        work()
    except (ImportError, PcwError) as error:
        return Result(task.name, task.unit, task.target, note=" ".join(str(error).split()))
    first = time.perf_counter() - started
    figures = []
    for _ in range(repeats):
        before = time.perf_counter()
        amount = work()
        elapsed = time.perf_counter() - before
        figures.append(1e6 * elapsed / amount if task.unit == MICROSECONDS else amount / elapsed)
    best = min(figures) if task.unit == MICROSECONDS else max(figures)
    return Result(task.name, task.unit, task.target, best, statistics.median(figures), first)


def odometry_update(method: str) -> Prepare:
    """Forward kinematics and odometry with its covariance, on joint angles that move and are noisy."""

    def prepare(robot: RobotDescription) -> Callable[[], float]:
        calls, dt = 2000, 2e-3
        rng = np.random.default_rng(1)
        angles = np.zeros((calls, robot.n, 2))
        angles[:, :, DRIVE] = 10.0 * dt * np.arange(calls)[:, None]
        angles[:, :, STEER] = np.sin(dt * np.arange(calls))[:, None]
        angles += rng.normal(0.0, 1e-5, angles.shape)
        parameters = OdometryParameters(method=method)
        start, _ = update(robot, parameters, initial_odometry(), angles[0], dt)

        def work() -> float:
            state = start
            for joint_position in angles:
                state, _ = update(robot, parameters, state, joint_position, dt)
            return calls

        return work

    return prepare


def slip_detection(n_slipping: int) -> Prepare:
    """Which wheels slip, from noisy joints; with slip the search for them is at work."""

    def prepare(robot: RobotDescription) -> Callable[[], float]:
        calls, dt = 2000, 2e-3
        rng = np.random.default_rng(3)
        detector, twist = SlipConsensus(robot), np.array([0.5, 0.1, 0.2])
        position = np.zeros((robot.n, 2))
        velocity = inverse_kinematics(robot, position[:, STEER].copy(), twist)
        velocity[:n_slipping, DRIVE] += 0.3 / robot.wheel_radius[:n_slipping]
        velocities = velocity + rng.normal(0.0, robot.sensors.encoders.velocity_noise, (calls, robot.n, 2))
        start, _ = detector.step(detector.initial_state(), position, velocities[0], 0.0)

        def work() -> float:
            state = start
            for joint_velocity in velocities:
                state, _ = detector.step(state, position, joint_velocity, dt)
            return calls

        return work

    return prepare


def imu_slip(part: str) -> Prepare:
    """The filter of encoders and IMU: `predict` with each IMU sample or `correct` with each measurement of the joints."""

    def prepare(robot: RobotDescription) -> Callable[[], float]:
        calls, rng = 2000, np.random.default_rng(4)
        slip_filter, position = ImuSlip(robot), np.zeros((robot.n, 2))
        velocity = inverse_kinematics(robot, position[:, STEER].copy(), np.array([0.5, 0.0, 0.0]))
        velocities = velocity + rng.normal(0.0, robot.sensors.encoders.velocity_noise, (calls, robot.n, 2))
        samples = rng.normal(0.0, 0.002, (calls, 3)).tolist()
        start, _ = slip_filter.correct(slip_filter.initial_state(), position, velocity, 0.0)
        start = slip_filter.predict(start, 0.0, 0.0, 0.0, 1e-3)

        def work() -> float:
            state = start
            if part == "predict":
                for gyro, x, y in samples:
                    state = slip_filter.predict(state, gyro, x, y, 1e-3)
            else:
                for joint_velocity in velocities:
                    state, _ = slip_filter.correct(state, position, joint_velocity, 2e-3)
            return calls

        return work

    return prepare


def augmented_object(robot: RobotDescription) -> Callable[[], float]:
    """Lambda and theta, headings and twist new in every call."""
    calls = 5000
    rng = np.random.default_rng(2)
    headings, twists = rng.uniform(-np.pi, np.pi, (calls, robot.n)), rng.uniform(-1.0, 1.0, (calls, 3))
    model = AugmentedObjectModel(robot)

    def work() -> float:
        for heading, twist in zip(headings, twists, strict=True):
            model.evaluate(heading, twist)
        return calls

    return work


def slip_observer(measured: str) -> Prepare:
    """The sliding-mode observer of the whole robot, one step on joints that move, with all its checks and flags."""

    def prepare(robot: RobotDescription) -> Callable[[], float]:
        calls, dt = 2000, 2e-3
        rng = np.random.default_rng(3)
        moments = dt * np.arange(calls)[:, None, None] * np.ones((1, robot.n, 2))
        positions = np.cumsum(5.0 + np.sin(moments), axis=0) * dt
        positions[:, :, STEER] = 0.5 * np.sin(moments[:, :, STEER])
        velocities = np.gradient(positions, dt, axis=0) + rng.normal(0.0, 0.005, positions.shape)
        efforts = rng.normal(0.0, 0.2, positions.shape)
        observer = RobotSlidingModeObserver(robot, SlidingModeParameters(measured=measured))
        readings = [JointMeasurement(*reading) for reading in zip(positions, velocities, efforts, strict=True)]

        def work() -> float:
            state = observer.initial_state()
            for reading in readings:
                state, _ = observer.step(state, reading, dt)
            return calls

        return work

    return prepare


def terrain(robot: RobotDescription) -> Callable[[], float]:
    """The ground under all casters, slip slopes included, from slips that swing; what the terrain node does per reading."""
    calls, dt, n = 2000, 2e-3, robot.n
    rng = np.random.default_rng(6)
    estimators, slopes = RobotTerrain(robot), SlipSlope(robot)
    readings = []
    for k in range(calls):
        slip = 0.1 * (1.0 - np.cos(4.0 * dt * k)) * np.ones(n)
        sensed = np.column_stack([0.8 / (1.0 - slip), np.zeros(n)]) + rng.normal(0.0, 1e-3, (n, 2))
        force = np.column_stack([2000.0 * slip / (1.0 + 100.0 * slip * slip), np.zeros(n)])
        readings.append(RobotReading(sensed, np.column_stack([sensed[:, 0] - 0.8, np.zeros(n)]), force, np.zeros(n)))

    def work() -> float:
        state, creep = estimators.initial_state(), slopes.initial_state()
        for reading in readings:
            state, found = estimators.step(state, reading, dt)
            creep, _ = slopes.step(creep, reading, found.normal_force, dt)
        return calls

    return work


def terrain_of_one_wheel(robot: RobotDescription) -> Callable[[], float]:
    """The estimator of one wheel, whose slip swings about its critical slip."""
    calls, dt = 2000, 2e-3
    estimator = TerrainEstimator(TerrainParameters(contact=robot.tyres[0]))
    slips = 0.1 * (1.0 - np.cos(4.0 * dt * np.arange(calls)))
    readings = [WheelReading(0.8 / (1.0 - s), 0.8, 2000.0 * s / (1.0 + 100.0 * s * s), 200.0) for s in slips.tolist()]

    def work() -> float:
        state = estimator.initial_state()
        for reading in readings:
            state, _ = estimator.step(state, reading, dt)
        return calls

    return work


def with_all_effects(prepare: Prepare) -> Prepare:
    """The same task with every effect of the vocabulary at work, at its typical size, on all casters."""

    def prepare_with_effects(robot: RobotDescription) -> Callable[[], float]:
        entries = [
            {"name": effect.name, **{p.name: p.typical for p in effect.parameters if p.default is None}}
            for effect in all_effects().values()
        ]
        return prepare(dataclasses.replace(robot, physics=read_physics(entries, robot.caster_names)))

    return prepare_with_effects


def to_and_fro(plant: Plant) -> np.ndarray:
    """Return drive torques (n, 2) that push the robot to and fro when their sign changes, a fifth of what it can."""
    torque = np.zeros((plant.robot.n, 2))
    torque[:, DRIVE] = 0.2 * plant.robot.torque_limit[:, DRIVE]
    return torque


def reduced_in_batch(robot: RobotDescription) -> Callable[[], float]:
    """The reduced plant over a second of simulated time in one call."""
    plant = make_plant("reduced", robot, STEP)
    torque = to_and_fro(plant)

    def work() -> float:
        plant.reset()
        for sign in (1.0, -1.0) * 10:
            plant.step(sign * torque, 1000)
        return 20.0

    return work


def reduced_stepped(read: bool) -> Prepare:
    """The reduced plant step by step from Python; with `read`, its state is read after every step as well."""

    def prepare(robot: RobotDescription) -> Callable[[], float]:
        plant = make_plant("reduced", robot, STEP)
        torques = [sign * to_and_fro(plant) for sign in (1.0, -1.0)]

        def work() -> float:
            plant.reset()
            for k in range(4000):
                plant.step(torques[k // 1000 % 2])
                if read:
                    plant.state()
            return 4000 * STEP

        return work

    return prepare


def with_controller(plant_name: str, seconds: float) -> Prepare:
    """Follow a turning twist in closed loop: plant, state, sensors, odometry, computed torque, torque limits."""

    def prepare(robot: RobotDescription) -> Callable[[], float]:
        plant = make_plant(plant_name, robot, STEP)
        simulated = SimulatedRobot(plant)
        controller, limits, parameters = ComputedTorque(robot), TorqueLimits.of_robot(robot), OdometryParameters()
        reference = TwistReference(np.array([0.5, 0.1, 0.4]))

        # The robot drives on from repeat to repeat: a reset lets it settle on its springs, which is no part of a run.
        samples = list(simulated.advance())
        control, odometry, torque = controller.initial_state(), initial_odometry(), np.zeros((robot.n, 2))
        dt, saturated = simulated.control_period, False

        def work() -> float:
            nonlocal samples, control, odometry, torque, saturated
            started = simulated.time_ns
            while simulated.time_ns < started + 1e9 * seconds:
                reading = samples[-1].reading
                assert isinstance(reading, JointReading)  # the joints come last
                odometry, _ = update(robot, parameters, odometry, reading.position, dt)
                measurement = ControllerMeasurement(reading.position, reading.velocity, odometry.pose, saturated)
                control, output = controller.step(control, measurement, reference, dt)
                limited = limit_torque(limits, torque, output.torque, reading.velocity, dt)
                torque, saturated = limited.torque, limited.saturated
                simulated.command(JointCommand(effort=torque))
                samples = list(simulated.advance())
            # A robot that does not follow was not simulated at work.
            travelling = float(np.hypot(*plant.state().twist[:2]))
            if not 0.4 < travelling < 0.6:
                raise PcwError(f"the robot goes at {travelling:.2f} m/s instead of 0.51 m/s")
            return (simulated.time_ns - started) / 1e9

        return work

    return prepare


TASKS = (
    Task("forward kinematics and odometry, one update", MICROSECONDS, 20.0, odometry_update("differential")),
    Task("the same by the displacement model", MICROSECONDS, None, odometry_update("displacement")),
    Task("slip of encoders, all wheels roll, one step", MICROSECONDS, 15.0, slip_detection(0)),
    Task("the same, one wheel slips", MICROSECONDS, 15.0, slip_detection(1)),
    Task("slip by IMU, one sample of it", MICROSECONDS, 5.0, imu_slip("predict")),
    Task("the same, one measurement of the joints", MICROSECONDS, None, imu_slip("correct")),
    Task("Lambda and theta", MICROSECONDS, 5.0, augmented_object),
    Task("slip observer of the robot, from speeds", MICROSECONDS, 40.0, slip_observer("speed")),
    Task("angle-only slip observer of the robot", MICROSECONDS, 40.0, slip_observer("angle")),
    Task("terrain of all casters, one reading", MICROSECONDS, None, terrain),
    Task("terrain of one wheel, one step", MICROSECONDS, 20.0, terrain_of_one_wheel),
    Task("reduced plant at 1 ms, in batch", REAL_TIME, 800.0, reduced_in_batch),
    Task("reduced plant at 1 ms, stepped from Python", REAL_TIME, 200.0, reduced_stepped(read=False)),
    Task("the same, its state read after each step", REAL_TIME, None, reduced_stepped(read=True)),
    Task("reduced plant in batch, all effects at work", REAL_TIME, 300.0, with_all_effects(reduced_in_batch)),
    Task("reduced plant with sensors and controller", REAL_TIME, None, with_controller("reduced", 1.0)),
    Task("PyBullet plant with sensors and controller", REAL_TIME, 8.0, with_controller("pybullet", 1.0)),
    Task("MuJoCo plant with sensors and controller", REAL_TIME, None, with_controller("mujoco", 1.0)),
    Task("PyBullet plant, all effects, with the same", REAL_TIME, 6.0, with_all_effects(with_controller("pybullet", 1.0))),
)


def machine() -> dict[str, str]:
    """Return what the figures were measured on."""
    processor = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                processor = line.partition(":")[2].strip()
                break
    except OSError:
        pass  # not Linux: the short name has to do
    facts = {"processor": processor, "cores": str(os.cpu_count()), "system": f"{platform.system()} {platform.release()}"}
    if hasattr(os, "getloadavg"):
        facts["load_average"] = f"{os.getloadavg()[0]:.1f}"
    facts["python"] = platform.python_version()
    for library in LIBRARIES:
        try:
            facts[library] = version(library)
        except PackageNotFoundError:
            facts[library] = "not installed"
    return facts


def figure(value: float | None) -> str:
    """Return a figure with three digits, or a dash."""
    if value is None:
        return "-"
    return f"{value:.0f}" if value >= 100.0 else f"{value:.3g}"


def row(result: Result) -> str:
    """Return one line of the table."""
    sign = "<=" if result.unit == MICROSECONDS else ">="
    target = "" if result.target is None else f"{sign} {figure(result.target)}"
    mark = {True: "ok", False: "MISSED", None: ""}[result.reached]
    line = f"{result.name:<45}{figure(result.best):>9}{figure(result.median):>9}  {result.unit:<12}{target:>8}  {mark}"
    return f"{line.rstrip()}  {result.note}" if result.note else line.rstrip()


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the table, and write it as JSON if asked."""
    parser = argparse.ArgumentParser(prog="benchmark", description="Measure how fast this machine runs the PCW packages.")
    parser.add_argument("--robot", default="thesis", help="shipped robot or path of a robot file (default: %(default)s)")
    parser.add_argument("--repeats", type=int, default=15, help="how often each figure is measured (default: %(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE, a new one, as well")
    options = parser.parse_args(arguments)
    if options.repeats < 1:
        parser.error(f"argument --repeats: {options.repeats} is not allowed; allowed: at least 1")
    try:
        robot = load_robot(options.robot)
        robot.require_torque_control()
        if options.json is not None:
            require_new_file(options.json, "argument --json")
    except PcwError as error:
        parser.error(str(error))
    facts = machine()
    print(f"robot {robot.name}; " + "; ".join(f"{name.replace('_', ' ')} {value}" for name, value in facts.items()))
    print(f"\n{'':<45}{'best':>9}{'median':>9}  {'':<12}{'target':>8}", flush=True)
    results = []
    for task in TASKS:
        results.append(measure(task, robot, options.repeats))
        print(row(results[-1]), flush=True)
    missed = sum(result.reached is False for result in results)
    first = sum(result.first for result in results)
    print(
        f"\n{options.repeats} repeats; {'all targets reached' if not missed else f'{missed} missed'}; "
        f"first calls, compiling included, took {first:.1f} s"
    )
    busy = float(facts.get("load_average", "0"))
    if busy > 0.5 * (os.cpu_count() or 1):
        print(f"other programs were running (load average {busy:.1f}): the medians are worse than this machine's own")
    if options.json:
        content = {
            "format": FORMAT,
            "robot": robot.name,
            "machine": facts,
            "repeats": options.repeats,
            "results": [dataclasses.asdict(result) | {"reached": result.reached} for result in results],
        }
        options.json.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

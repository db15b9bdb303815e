"""The slip observers of whole robots side by side, on runs of the reduced plant.

    python -m pcw_sim_bridge.slip_observer_comparison [--seeds 5] [--out pcw_estimation/docs/slip_observers_robot.md]

Every run follows a turning twist by computed torque, and for 0.2 s gets more drive torque than the ground holds: on all
wheels, where encoders are blind, or on one. The observers believe in a robot whose masses, inertias and grounds are off.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcw_control.computed_torque import ComputedTorque
from pcw_control.controller_interface import ControllerMeasurement, TwistReference
from pcw_control.torque_limits import TorqueLimits, limit_torque
from pcw_description.differential_kinematics import wheel_jacobian
from pcw_description.odometry import OdometryParameters, update
from pcw_description.odometry import initial_state as initial_odometry
from pcw_description.robot_description import (
    DRIVE,
    GRAVITY,
    STEER,
    Caster,
    ContactDescription,
    FloatArray,
    RobotDescription,
)
from pcw_description.robot_file import load_robot
from pcw_estimation import encoder_slip
from pcw_estimation.motor_current_slip import RobotCurrentDetector
from pcw_estimation.robot_sliding_mode_observer import RobotSlidingModeObserver
from pcw_estimation.sliding_mode_observer import SlidingModeParameters
from pcw_estimation.slip_estimate import JointMeasurement
from pcw_estimation.slip_kalman_filter import RobotKalmanFilter

from .plants.factory import make_plant
from .plants.plant import PlantState
from .sensors import JointReading
from .simulated_robot import JointCommand, SimulatedRobot

ROBOTS = ("thesis", "tidybot2", "xr4000", "dyros_pcv", "flow_base")
DURATION, BEGIN, COUNTED_FROM = 4.0, 0.6, 0.8  # of a run, of the observers in it, and of counting their errors [s]
PUSH_FROM, PUSH_UNTIL = 1.5, 1.7  # of the torque that the ground does not hold [s]
PUSH = 1.3  # times what the ground holds under an even load
# Longest slip until which an observer is judged as if in the middle of it [s].
AFTERMATH = 0.1


@dataclasses.dataclass(frozen=True)
class Instant:
    """One reading and the truth at its time."""

    dt: float
    measurement: JointMeasurement
    truth: PlantState


def drive_run(robot: RobotDescription, pushed: Sequence[int], seed: int, duration: float = DURATION) -> list[Instant]:
    """Drive a robot on the reduced plant and push some of its wheels past the ground's hold.

    Args:
        robot: as it really is; the controller knows it.
        pushed: indices of the casters that get too much torque.
        seed: of the manoeuvre and of all noise.
        duration: [s].
    """
    rng = np.random.default_rng(seed)
    pace, phase = rng.uniform(0.8, 1.2, 3), rng.uniform(0.0, 0.5, 3)
    simulated = SimulatedRobot(make_plant("reduced", robot), seed)
    controller = ComputedTorque(robot)
    control = controller.initial_state()
    limits, torque = TorqueLimits.of_robot(robot), np.zeros((robot.n, 2))
    odometry, parameters = initial_odometry(), OdometryParameters()
    saturated, before, run = False, -1, []
    load = robot.total_mass * GRAVITY / robot.n
    push = np.zeros((robot.n, 2))
    for index in pushed:
        push[index, DRIVE] = PUSH * robot.tyres[index].mu_p * load * robot.wheel_radius[index]
    while simulated.time_ns < duration * 1e9:
        reading = list(simulated.advance())[-1].reading
        assert isinstance(reading, JointReading)  # the joints come last
        dt = (simulated.time_ns - before) * 1e-9 if before >= 0 else simulated.control_period
        before, now = simulated.time_ns, simulated.time_ns * 1e-9
        run.append(Instant(dt, JointMeasurement(reading.position, reading.velocity, reading.effort), simulated.plant.state()))
        odometry, _ = update(robot, parameters, odometry, reading.position, dt)
        swing = np.sin(pace * now * np.array([2.0, 1.5, 1.0]) + phase)
        reference = TwistReference(np.array([0.3, 0.0, 0.0]) + np.array([0.3, 0.2, 0.5]) * swing)
        measured = ControllerMeasurement(reading.position, reading.velocity, odometry.pose, saturated)
        control, output = controller.step(control, measured, reference, dt)
        limited = limit_torque(limits, torque, output.torque, reading.velocity, dt)
        torque, saturated = limited.torque, limited.saturated
        pushing = PUSH_FROM <= now < PUSH_UNTIL
        simulated.command(JointCommand(effort=torque + push if pushing else torque))
    return run


def believed(robot: RobotDescription, error: float, rng: np.random.Generator) -> RobotDescription:
    """Return a robot whose masses, inertias and ground are off by up to `error`, and its wheel radii by a tenth of it."""
    mass, rotor, mu, slip = 1.0 + rng.uniform(-error, error, 4)

    def ground(contact: ContactDescription) -> ContactDescription:
        lateral = dataclasses.replace(
            contact.lateral, mu_p=contact.lateral.mu_p * mu, lambda_p=contact.lateral.lambda_p * slip
        )
        return dataclasses.replace(contact, mu_p=contact.mu_p * mu, lambda_p=contact.lambda_p * slip, lateral=lateral)

    def module(caster: Caster) -> Caster:
        rotors = dataclasses.replace(caster.rotors, drive=caster.rotors.drive * rotor, steer=caster.rotors.steer * rotor)
        radius = caster.wheel_radius * (1.0 + 0.1 * rng.uniform(-error, error))
        return dataclasses.replace(caster, rotors=rotors, wheel_radius=radius)

    chassis = dataclasses.replace(
        robot.chassis, mass=robot.chassis.mass * mass, inertia_zz=robot.chassis.inertia_zz * mass
    )
    changed = dataclasses.replace(robot, chassis=chassis, contact=ground(robot.contact))
    return changed.with_casters(robot.caster_names, module)


class EncoderConsistency:
    """Encoder slip (4.5) with the interface of the observers, as far as the comparison needs it."""

    def __init__(self, robot: RobotDescription) -> None:
        self._robot, self._parameters = robot, encoder_slip.EncoderSlipParameters()

    def initial_state(self) -> encoder_slip.EncoderSlipState:
        """Return the state before the first reading."""
        return encoder_slip.initial_state(self._robot)

    def step(
        self, state: encoder_slip.EncoderSlipState, measurement: JointMeasurement, dt: float
    ) -> tuple[encoder_slip.EncoderSlipState, encoder_slip.EncoderSlipOutput]:
        """Take one reading."""
        return encoder_slip.step(self._robot, self._parameters, state, measurement.position, measurement.velocity, dt)


METHODS: dict[str, Callable[[RobotDescription], Any]] = {
    "sliding mode, speed": RobotSlidingModeObserver,
    "sliding mode, angle": lambda robot: RobotSlidingModeObserver(robot, SlidingModeParameters(measured="angle")),
    "Kalman filter": RobotKalmanFilter,
    "encoder consistency": EncoderConsistency,
    "motor current": RobotCurrentDetector,
}


@dataclasses.dataclass(frozen=True)
class RobotScore:
    """Errors of one method on one run.

    Attributes:
        grip, slip, after: RMS error of all wheel-centre velocities before the push, from then until no wheel slips past its
            critical slip any more, and afterwards [m/s].
        worst: largest error of all [m/s].
        force: RMS error of the contact forces along [N]; NaN where there are none.
        outside: part of the readings at which a velocity was called valid and was further off than its bound.
        valid: part of the readings at which all velocities were called valid.
        settling: from the beginning until errors stay below 5 % of the fastest wheel of the run, up to the push [s].
        cost: time per step [us].
    """

    grip: float
    slip: float
    after: float
    worst: float
    force: float
    outside: float
    valid: float
    settling: float
    cost: float


def judge(observer: Any, robot: RobotDescription, run: Sequence[Instant]) -> RobotScore:
    """Run one method on one run; `robot` is the real one."""
    state, spent = observer.initial_state(), 0.0
    moments, errors, forces, bounds, valids, loose, speeds = [], [], [], [], [], [], []
    for instant in run:
        if instant.truth.time < BEGIN:
            continue
        started = time.perf_counter()
        state, estimate = observer.step(state, instant.measurement, instant.dt)
        spent += time.perf_counter() - started
        truth = instant.truth
        jacobian = wheel_jacobian(robot, truth.joint_position[:, STEER].copy())
        velocity = (jacobian @ truth.twist).reshape(-1, 2)
        found = getattr(estimate, "wheel_velocity", None)
        if found is None:
            found = (jacobian @ estimate.twist).reshape(-1, 2)
        moments.append(truth.time)
        errors.append(found - velocity)
        speeds.append(np.linalg.norm(velocity, axis=1).max())
        known = hasattr(estimate, "force")
        forces.append(estimate.force[:, 0] - truth.contact_force[:, 0] if known else np.full(robot.n, np.nan))
        bounds.append(getattr(estimate, "velocity_bound", np.inf))
        valids.append(bool(np.all(getattr(estimate, "velocity_valid", False))))
        rolling = robot.wheel_radius * truth.joint_velocity[:, DRIVE]
        reference = np.maximum(np.maximum(np.abs(rolling), np.abs(velocity[:, 0])), 0.1)
        critical = np.array([tyre.lambda_p for tyre in robot.tyres])
        loose.append(bool(np.any(np.abs(truth.slip[:, 0]) > critical * reference)))
    moment, error = np.array(moments), np.array(errors)
    largest = np.abs(error).max(axis=(1, 2))
    slipping = np.nonzero(np.array(loose) & (moment >= PUSH_FROM))[0]
    ended = moment[slipping[-1]] + AFTERMATH if len(slipping) else PUSH_UNTIL
    unsettled = np.nonzero((largest > 0.05 * max(speeds)) & (moment < PUSH_FROM))[0]
    counted = moment >= COUNTED_FROM

    def rms(values: FloatArray) -> float:
        return float(np.sqrt(np.mean(values**2))) if values.size else 0.0

    return RobotScore(
        grip=rms(error[counted & (moment < PUSH_FROM)]),
        slip=rms(error[(moment >= PUSH_FROM) & (moment <= ended)]),
        after=rms(error[moment > ended]),
        worst=float(largest[counted].max()),
        force=rms(np.array(forces)[counted]),
        outside=float(np.mean((largest > np.array(bounds))[counted] & np.array(valids)[counted])),
        valid=float(np.mean(np.array(valids)[counted])),
        settling=float(moment[unsettled[-1]]) - BEGIN if len(unsettled) else 0.0,
        cost=spent / len(moments) * 1e6,
    )


def table(names: Sequence[str], seeds: int, all_wheels: bool, error: float) -> list[str]:
    """Return the lines of one table."""
    lines = [
        "| robot | method | settling | grip | slip | after | worst | force | valid | outside its bound | cost per step |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name in names:
        robot = load_robot(name)
        scores: dict[str, list[RobotScore]] = {method: [] for method in METHODS}
        for seed in range(seeds):
            rng = np.random.default_rng([seed, 7])
            pushed = range(robot.n) if all_wheels else [int(rng.integers(robot.n))]
            run, wrong = drive_run(robot, pushed, seed), believed(robot, error, rng)
            for method, make in METHODS.items():
                scores[method].append(judge(make(wrong), robot, run))
        for method, found in scores.items():
            rms = {
                field: 1e3 * float(np.sqrt(np.mean([getattr(s, field) ** 2 for s in found])))
                for field in ("grip", "slip", "after")
            }
            force = float(np.sqrt(np.mean([s.force**2 for s in found])))
            lines.append(
                f"| {name} | {method} | {1e3 * float(np.median([s.settling for s in found])):.0f} ms | "
                f"{rms['grip']:.1f} mm/s | {rms['slip']:.1f} mm/s | {rms['after']:.1f} mm/s | "
                f"{1e3 * max(s.worst for s in found):.0f} mm/s | {'-' if np.isnan(force) else f'{force:.1f} N'} | "
                f"{np.mean([s.valid for s in found]):.0%} | {np.mean([s.outside for s in found]):.1%} | "
                f"{min(s.cost for s in found):.0f} us |"
            )
            print(lines[-1], flush=True)
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the comparison and write the document."""
    parser = argparse.ArgumentParser(prog="slip_observer_comparison", description="Compare slip observers of whole robots.")
    parser.add_argument("--seeds", type=int, default=5, help="runs per robot and table (default: %(default)s)")
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), help="shipped robots (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("pcw_estimation/docs/slip_observers_robot.md"), help="file to write")
    options = parser.parse_args(arguments)
    if options.seeds < 1:
        parser.error(f"argument --seeds: {options.seeds} is not allowed; allowed: at least 1")
    parts = [
        "# Slip observers on whole robots",
        "",
        f"Written by `python -m pcw_sim_bridge.slip_observer_comparison --seeds {options.seeds}`; nothing here is typed in.",
        "",
        f"Runs of {DURATION:g} s of the reduced plant along a turning twist, with the sensors of the robot file. At "
        f"{PUSH_FROM:g} s drives get {PUSH:g} times the torque that the ground holds for {PUSH_UNTIL - PUSH_FROM:.1f} s, "
        f"within their limits. Observers begin at {BEGIN:g} s, while the robot moves, the sliding-mode ones at v = 0. Errors "
        "are of all wheel-centre velocities, along and across: in grip before the push, in slip, and after it. Settling: from "
        "the beginning until below 5 % of the run's greatest speed. `valid`: readings at which all velocities are vouched for "
        "(the encoders vouch for nothing). Cost: a call from Python on this machine, the best run's mean.",
        "",
    ]
    for title, all_wheels, error in (
        ("All wheels pushed, numbers right", True, 0.0),
        ("All wheels pushed, numbers off by up to 10 %, radii by 1 %", True, 0.1),
        ("One wheel pushed, numbers off by up to 10 %, radii by 1 %", False, 0.1),
    ):
        parts += [f"## {title}", "", *table(options.robots, options.seeds, all_wheels, error), ""]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text("\n".join(parts), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

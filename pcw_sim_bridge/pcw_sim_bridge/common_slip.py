"""All wheels on ground that holds less than is asked for: slip that they have in common, which encoders do not see.

The robot is to speed up to 1 m/s and to stop again at twice the acceleration that mu = 0.1 gives. With the slip known (here
from the truth) `slip_ratio_limit` keeps every wheel below its critical slip ratio; SCFC, which has encoders only, cannot.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from pcw_control.controller_interface import ControllerMeasurement, TwistReference
from pcw_control.controllers import CONTROLLERS, make_controller
from pcw_control.quintic_trajectory import MotionLimits
from pcw_control.torque_limits import TorqueLimits, limit_torque
from pcw_description.robot_description import DRIVE, GRAVITY, RobotDescription
from pcw_description.robot_file import load_robot

from .plants.factory import make_plant
from .split_friction import LOW_FRICTION, SPEED, late_torques, slippery

ROBOTS = ("thesis", "tidybot2", "xr4000", "dyros_pcv", "flow_base")
METHODS = ("slip_constraint_force", "slip_ratio_limit")
ASKED = 2.0  # times the acceleration that the ground gives
TURN, DURATION, LEAST_SPEED = 1.6, 3.0, 0.3  # [s], [s], [m/s]
COLUMNS = ("robot", "controller", "slip", "worst_ratio", "acceleration", "braking")


@dataclasses.dataclass(frozen=True)
class CommonSlip:
    """What one run shows.

    Attributes:
        slip: RMS slip velocity of the worst wheel [m/s].
        worst_ratio: largest slip ratio of any wheel above LEAST_SPEED [1].
        acceleration, braking: of the robot over 0.4 s from 0.2 s after the beginning of each [m/s^2].
    """

    slip: float
    worst_ratio: float
    acceleration: float
    braking: float


def drive_and_brake(robot: RobotDescription, controller_name: str) -> CommonSlip:
    """Speed up and stop on the reduced plant."""
    physics = (slippery(robot, robot.caster_names, LOW_FRICTION), *late_torques(robot))
    plant = make_plant("reduced", dataclasses.replace(robot, physics=physics))
    limits = MotionLimits(3.0, 10.0, 3.0, 10.0)
    parameters = CONTROLLERS[controller_name].parameters(limits=limits)  # type: ignore[call-arg]
    controller = make_controller(controller_name, robot, parameters)
    state, bounds = controller.initial_state(), TorqueLimits.of_robot(robot)
    torque, saturated, rows = np.zeros((robot.n, 2)), False, []
    period = 1.0 / robot.sensors.encoders.rate
    asked = ASKED * LOW_FRICTION * GRAVITY
    for cycle in range(round(DURATION / period)):
        truth, now = plant.state(), cycle * period
        wanted = min(SPEED, asked * now) if now < TURN else max(0.0, SPEED - asked * (now - TURN))
        measured = ControllerMeasurement(
            truth.joint_position, truth.joint_velocity, np.zeros(3), saturated, slip=truth.slip
        )
        state, output = controller.step(state, measured, TwistReference(np.array([wanted, 0.0, 0.0])), period)
        allowed = limit_torque(bounds, torque, output.torque, truth.joint_velocity, period)
        torque, saturated = allowed.torque, allowed.saturated
        plant.step(torque, round(period / plant.dt))
        rolling = robot.wheel_radius * truth.joint_velocity[:, DRIVE]
        speed = np.maximum(np.abs(rolling), np.abs(rolling - truth.slip[:, 0]))
        ratio = np.abs(truth.slip[:, 0]) / np.maximum(speed, LEAST_SPEED)
        rows.append((now, truth.twist[0], ratio.max(), *np.linalg.norm(truth.slip, axis=1)))
    run = np.array(rows)
    time, velocity = run[:, 0], run[:, 1]

    def gained(since: float) -> float:
        return float(np.interp(since + 0.4, time, velocity) - np.interp(since, time, velocity)) / 0.4

    slip = np.sqrt(np.mean(run[:, 3:] ** 2, axis=0)).max()
    return CommonSlip(float(slip), float(run[:, 2].max()), gained(0.2), -gained(TURN + 0.2))


def rows() -> Iterator[tuple[object, ...]]:
    """Yield the rows of the study, see COLUMNS."""
    for name in ROBOTS:
        for controller_name in METHODS:
            score = drive_and_brake(load_robot(name), controller_name)
            yield name, controller_name, *(f"{value:.5f}" for value in vars(score).values())

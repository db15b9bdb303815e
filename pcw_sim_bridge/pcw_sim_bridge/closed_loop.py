"""A controller on a plant without a graph: the run that studies of controllers are made of."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from pcw_control.controller_interface import Controller, ControllerMeasurement, Reference
from pcw_control.torque_limits import TorqueLimits, limit_torque
from pcw_description.odometry import OdometryParameters, update
from pcw_description.odometry import initial_state as initial_odometry
from pcw_description.robot_description import FloatArray, RobotDescription

from .plants.factory import make_plant
from .sensors import JointReading
from .simulated_robot import JointCommand, SimulatedRobot


@dataclasses.dataclass(frozen=True)
class ClosedLoopRun:
    """What a run left behind; first axis is the control cycle.

    Attributes:
        time: (k,) [s].
        joint_position, joint_velocity: as measured (k, n, 2).
        torque: joint torques after the limits (k, n, 2) [N m].
        internal_force: wanted squeeze between pairs of wheels (k, n (n - 1) / 2) [N].
        reference_twist: (k, 3).
        odometric_pose: (k, 3) where the robot believes to be.
        pose, twist: the truth (k, 3).
        slip: true slip velocity at the contacts (k, n, 2) [m/s].
        states: the controller's own state after each cycle.
    """

    time: FloatArray
    joint_position: FloatArray
    joint_velocity: FloatArray
    torque: FloatArray
    internal_force: FloatArray
    reference_twist: FloatArray
    odometric_pose: FloatArray
    pose: FloatArray
    twist: FloatArray
    slip: FloatArray
    states: tuple[object, ...]


def run_closed_loop(
    robot: RobotDescription,
    controller: Controller,
    reference: Callable[[float], Reference],
    duration: float,
    plant: str = "reduced",
    seed: int = 0,
    steer_angle: FloatArray | None = None,
    limited: bool = True,
    measure: Callable[[ControllerMeasurement], ControllerMeasurement] | None = None,
    lifted: bool = False,
    observe: Callable[[JointReading, float], None] | None = None,
) -> ClosedLoopRun:
    """Drive a robot on a plant.

    Args:
        robot: as it really is, with the effects of its `physics`.
        controller: made of the robot as it is believed to be.
        reference: what to follow at a time [s].
        duration: [s].
        plant: see `make_plant`.
        seed: of all sensor noise.
        steer_angle: headings of the wheels at the start (n,) [rad]; None is all ahead.
        limited: whether the torques pass the torque limits.
        measure: what else the controller is told, added to a measurement.
        lifted: on a jack, the wheels off the ground.
        observe: what looks on: it is given every reading of the joints and the time since the last [s], before `measure`.
    """
    simulated = SimulatedRobot(make_plant(plant, robot, lifted=lifted), seed)
    if steer_angle is not None:
        simulated.plant.reset(steer_angle=steer_angle)
    believed: RobotDescription = controller.robot  # type: ignore[attr-defined]
    limits, torque, saturated = TorqueLimits.of_robot(believed), np.zeros((robot.n, 2)), False
    state, odometry, parameters = controller.initial_state(), initial_odometry(), OdometryParameters()
    before, rows = -1, []
    try:
        while simulated.time_ns < duration * 1e9:
            reading = list(simulated.advance())[-1].reading
            assert isinstance(reading, JointReading)  # the joints come last
            dt = (simulated.time_ns - before) * 1e-9 if before >= 0 else simulated.control_period
            before, now = simulated.time_ns, simulated.time_ns * 1e-9
            odometry, _ = update(believed, parameters, odometry, reading.position, dt)
            if observe is not None:
                observe(reading, dt)
            measured = ControllerMeasurement(reading.position, reading.velocity, odometry.pose, saturated)
            if measure is not None:
                measured = measure(measured)
            state, output = controller.step(state, measured, reference(now), dt)
            torque, saturated = output.torque, False
            if limited:
                allowed = limit_torque(limits, torque, output.torque, reading.velocity, dt)
                torque, saturated = allowed.torque, allowed.saturated
            truth = simulated.plant.state()
            rows.append((
                now, reading.position, reading.velocity, torque, output.internal_force, output.reference_twist,
                odometry.pose, truth.pose, truth.twist, truth.slip, state,
            ))
            simulated.command(JointCommand(effort=torque))
    finally:
        simulated.close()
    *columns, states = zip(*rows)
    arrays = [np.array(column) for column in columns]
    time, q, q_dot, tau, internal, V_d, odometric, pose, twist, slip = arrays
    return ClosedLoopRun(time, q, q_dot, tau, internal, V_d, odometric, pose, twist, slip, tuple(states))

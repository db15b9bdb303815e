"""Controllers that close the loop of a run without a graph: joints and a wanted twist in, a command to the drives out."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from pcw_control import controllers
from pcw_control.controller_interface import ControllerMeasurement, TwistReference
from pcw_control.torque_limits import TorqueLimits, limit_torque
from pcw_description.differential_kinematics import forward_kinematics, inverse_kinematics
from pcw_description.errors import nearest_name
from pcw_description.robot_description import STEER, FloatArray, RobotDescription

from .plants.plant import PlantError
from .sensors import JointReading
from .simulated_robot import JointCommand

# Nobody pushes the robot of a run, so those that give way to a push are left out.
CONTROLLER_NAMES = (
    *(name for name, entry in controllers.CONTROLLERS.items() if "external_wrench" not in entry.parameters.uses),
    "velocity_loops",
)


class RunController(Protocol):
    """What drives a robot along a twist; None as a twist is motors off."""

    def command(self, joints: JointReading, twist: FloatArray | None, dt: float) -> JointCommand:
        """Return the command for a twist (3,) in base_link; `dt` is the time since the command before [s]."""


def make_controller(name: str, believed: RobotDescription) -> RunController:
    """Make a controller of a robot as it is believed to be.

    Raises:
        PlantError: unknown name.
        KinematicsError: a caster without offset.
    """
    if name not in CONTROLLER_NAMES:
        raise PlantError(f"controller {name!r} is not allowed; {nearest_name(name, CONTROLLER_NAMES)}")
    return VelocityLoopsRun(believed) if name == "velocity_loops" else TorqueRun(name, believed)


class TorqueRun:
    """A controller of pcw_control by its name, and the torque limits, as in its node."""

    def __init__(self, name: str, believed: RobotDescription) -> None:
        self._robot = believed
        self._controller, self._limits = controllers.make_controller(name, believed), TorqueLimits.of_robot(believed)
        self._state = self._controller.initial_state()
        self._torque, self._saturated = np.zeros((believed.n, 2)), False

    def command(self, joints: JointReading, twist: FloatArray | None, dt: float) -> JointCommand:
        """Return joint torques."""
        if twist is None:
            # When the motors are on again the reference begins at the twist that the robot has then.
            rolling = forward_kinematics(self._robot, _steer_angle(joints), joints.velocity)
            self._state = self._controller.initial_state(rolling)
            self._torque, self._saturated = np.zeros((self._robot.n, 2)), False
            return JointCommand(effort=self._torque)
        measurement = ControllerMeasurement(joints.position, joints.velocity, np.zeros(3), self._saturated)
        self._state, wanted = self._controller.step(self._state, measurement, TwistReference(twist), dt)
        limited = limit_torque(self._limits, self._torque, wanted.torque, joints.velocity, dt)
        self._torque, self._saturated = limited.torque, limited.saturated
        return JointCommand(effort=self._torque)


class VelocityLoopsRun:
    """Inverse kinematics, (3.25), and the drives' own velocity loops: how a simple robot is driven.

    Nothing is known here of masses, of other casters or of how fast a twist may change. Where a joint would exceed its speed
    limit all joints are slowed down together, so that the direction is kept.
    """

    def __init__(self, believed: RobotDescription) -> None:
        believed.require_torque_control()
        self._robot = believed

    def command(self, joints: JointReading, twist: FloatArray | None, dt: float) -> JointCommand:
        """Return joint speeds; zero torque with the motors off."""
        if twist is None:
            return JointCommand(effort=np.zeros((self._robot.n, 2)))
        speed = inverse_kinematics(self._robot, _steer_angle(joints), twist)
        return JointCommand(velocity=speed / max(1.0, np.max(np.abs(speed) / self._robot.speed_limit)))


def _steer_angle(joints: JointReading) -> FloatArray:
    return np.ascontiguousarray(joints.position[:, STEER])  # the layout that the kernels are compiled for

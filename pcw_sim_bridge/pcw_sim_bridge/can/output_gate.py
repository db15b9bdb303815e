"""The one place where torques and speeds for the drives are limited, last before they become frames.

In this order: not armed, NaN or infinity are zero; joint limits of the robot and the CAN file; over the gears to the motors;
current limits of the motors, torque constant times current. What comes out is finite and within all limits, whatever came in.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pcw_description.robot_description import FloatArray, RobotDescription

from .can_file import CanFile, joint_place, torque_limits
from .motor_map import MotorMap


@dataclasses.dataclass(frozen=True)
class GatedOutput:
    """What may be sent.

    Attributes:
        motor: torques [N m] or speeds [rad/s] of the motors (n, 2), in the drives' counting; finite.
        fault: it held NaN or infinity, and everything is zero.
        limited: it is less than what was asked for.
    """

    motor: FloatArray
    fault: bool = False
    limited: bool = False


class OutputGate:
    """The limits of one robot.

    Attributes:
        joint_torque: largest joint torques (n, 2) [N m].
        joint_speed: largest joint speeds (n, 2) [rad/s].
        motor_torque: largest motor torques (n, 2) [N m].
    """

    def __init__(self, robot: RobotDescription, file: CanFile, motor_map: MotorMap) -> None:
        self._map = motor_map
        self.joint_torque = torque_limits(file, robot)
        self.joint_speed = robot.speed_limit.copy()
        self.motor_torque = np.zeros((robot.n, 2))
        for joint in file.joints:
            self.motor_torque[joint_place(robot, joint.name)] = joint.torque_constant * joint.current_limit
        self._zero = np.zeros((robot.n, 2))

    def torque(self, wanted: FloatArray | None, armed: bool) -> GatedOutput:
        """Return motor torques for joint torques (n, 2) [N m]; None is zero."""
        if wanted is None or not armed:
            return GatedOutput(self._zero.copy())
        if wanted.shape != self._zero.shape or not np.isfinite(wanted).all():
            return GatedOutput(self._zero.copy(), fault=True)
        joint = np.clip(wanted, -self.joint_torque, self.joint_torque)
        motor = self._map.motor_torque(joint)
        allowed = np.clip(motor, -self.motor_torque, self.motor_torque)
        if not np.isfinite(allowed).all():
            return GatedOutput(self._zero.copy(), fault=True)
        return GatedOutput(allowed, limited=bool((joint != wanted).any() or (allowed != motor).any()))

    def velocity(self, wanted: FloatArray | None, armed: bool) -> GatedOutput:
        """Return motor speeds for joint speeds (n, 2) [rad/s]; None is zero."""
        if wanted is None or not armed:
            return GatedOutput(self._zero.copy())
        if wanted.shape != self._zero.shape or not np.isfinite(wanted).all():
            return GatedOutput(self._zero.copy(), fault=True)
        joint = np.clip(wanted, -self.joint_speed, self.joint_speed)
        return GatedOutput(self._map.motor_velocity(joint), limited=bool((joint != wanted).any()))

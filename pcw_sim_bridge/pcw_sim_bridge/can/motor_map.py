"""Between joints and motors: gears, coupling, signs and zeros.

With the gear matrix N of a caster, motors m = N q and, as power is the same on both sides, joint torques tau = N^T tau_m. A
drive that counts against the motor of the robot file has the sign -1; what the joints read at zero is taken off:

    q = N^-1 (s m) - q_0,    dq/dt = N^-1 (s dm/dt),    tau_m = s N^-T tau.
"""

from __future__ import annotations

import numpy as np

from pcw_description.robot_description import FloatArray, RobotDescription

from .can_file import CanFile, joint_place, zeros


class MotorMap:
    """The map of one robot; all arrays are (n, 2), drive and steer.

    Attributes:
        zero: what the joints read where they should read zero [rad]; homing and calibration change it.
    """

    def __init__(self, robot: RobotDescription, file: CanFile) -> None:
        self.sign = np.ones((robot.n, 2))
        for joint in file.joints:
            self.sign[joint_place(robot, joint.name)] = joint.sign
        self.zero = zeros(file, robot)
        self._gear = robot.gear_matrix
        self._inverse: FloatArray = np.linalg.inv(robot.gear_matrix).astype(np.float64)
        self._inverse_transposed = np.transpose(self._inverse, (0, 2, 1)).copy()
        self._transposed = np.transpose(self._gear, (0, 2, 1)).copy()

    def raw_joint_position(self, motor: FloatArray) -> FloatArray:
        """Return what the joints read before the zero is taken off [rad], of motor angles [rad]."""
        return _each(self._inverse, self.sign * motor)

    def joint_position(self, motor: FloatArray) -> FloatArray:
        """Return joint angles [rad] of motor angles [rad]."""
        return self.raw_joint_position(motor) - self.zero

    def motor_position(self, joint: FloatArray) -> FloatArray:
        """Return motor angles [rad] of joint angles [rad]."""
        return self.sign * _each(self._gear, joint + self.zero)

    def joint_velocity(self, motor: FloatArray) -> FloatArray:
        """Return joint speeds [rad/s] of motor speeds [rad/s]."""
        return _each(self._inverse, self.sign * motor)

    def motor_velocity(self, joint: FloatArray) -> FloatArray:
        """Return motor speeds [rad/s] of joint speeds [rad/s]."""
        return self.sign * _each(self._gear, joint)

    def joint_torque(self, motor: FloatArray) -> FloatArray:
        """Return joint torques [N m] of motor torques [N m]."""
        return _each(self._transposed, self.sign * motor)

    def motor_torque(self, joint: FloatArray) -> FloatArray:
        """Return motor torques [N m] of joint torques [N m]."""
        return self.sign * _each(self._inverse_transposed, joint)


def _each(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return each matrix (n, 2, 2) times its vector (n, 2)."""
    product: FloatArray = np.matmul(matrices, vectors[:, :, None])[:, :, 0]
    return product

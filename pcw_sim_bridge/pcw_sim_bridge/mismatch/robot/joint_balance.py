"""The channels of a robot whose wheels are off the ground: each joint's own balance.

    drive_torque/<caster>    H[tau_rho] - H[(I_r + J_rr) rho_ddot + J_rp phi_ddot]
    steer_torque/<caster>    H[tau_phi] - H[(I + m c^2 + J_pp) phi_ddot + J_rp rho_ddot]

with the robot standing on its jack. Where that leans, the weight of a module whose centre of mass is beside its steering axis
turns it. What wheels, tyres, floor and chassis do wrong does not show; what joints do shows by itself, without the forces of
all the others.
"""

from __future__ import annotations

import numpy as np

from pcw_description.robot_description import DRIVE, STEER

from ..regression.regression_problem import FloatArray
from .robot_motion import RobotMotion
from .rolling_model import NOTHING, ModelNumbers, Surroundings, added_torque, directions


def joint_sides(
    motion: RobotMotion, numbers: ModelNumbers, around: Surroundings = NOTHING
) -> tuple[FloatArray, FloatArray]:
    """Measured and predicted side of every channel at the motion's rate, (T, 2n) each; see `rolling_model.channel_sides`."""
    mass, lever_x, lever_y, inertia, axle, rolling, coupled, turning = numbers.modules[:, :8].T
    drive, steer = motion.acceleration[:, :, DRIVE], motion.acceleration[:, :, STEER]
    predicted = np.empty_like(motion.torque)
    predicted[:, :, DRIVE] = (axle + rolling) * drive + coupled * steer
    predicted[:, :, STEER] = (inertia + mass * (lever_x**2 + lever_y**2) + turning) * steer + coupled * drive
    measured = motion.torque + added_torque(motion, numbers, around)
    if around.pull is not None:
        c, s = np.moveaxis(directions(numbers.headings(motion.position)), 2, 0)
        arm_x, arm_y = lever_x * c - lever_y * s, lever_x * s + lever_y * c
        measured[:, :, STEER] += mass * (arm_x * around.pull[:, 1:] - arm_y * around.pull[:, :1])
    return measured.reshape(len(measured), -1), predicted.reshape(len(measured), -1)


def torque_of_motion(motion: RobotMotion, numbers: ModelNumbers, around: Surroundings = NOTHING) -> FloatArray:
    """The torques (T, n, 2) [N m] that would be reported if nothing were missing: what effects are functions of.

    Those that were reported hold the friction that is to be found. By them all of it would be friction under load, or
    torques that are none.
    """
    measured, predicted = joint_sides(motion, numbers, around)
    return motion.torque - (measured - predicted).reshape(motion.torque.shape)


class JointResponse:
    """What torques on the joints add to these channels: themselves. See `TorqueResponse`."""

    def apply(self, torque: FloatArray) -> FloatArray:
        """Return what torques (T, n, 2, K) [N m] change in measured minus predicted channels (T, 2n, K)."""
        return torque.reshape(len(torque), -1, torque.shape[3])

"""How fast a robot can be asked to move, whatever its casters point at: from its limits of speed, torque and friction.

The wheel centre of caster i moves with the velocity v of the chassis there. The caster follows slip-free with the steering
rate phi_dot = -v_across / b_x and the roll rate rho_dot = (v_along - b_y phi_dot) / r, (3.25) [Li2009]. Over all headings

    max |phi_dot| = v / |b_x|,      max |rho_dot| <= v (1 + |b_y / b_x|) / r,

the first while the caster turns round, when its joints are accelerated by up to

    max |phi_ddot| = v^2 / (2 b_x^2),      max |rho_ddot| <= (v^2 / |b_x| + |b_y| max |phi_ddot|) / r.

It has turned round after a way of a few offsets: ten, where it was driven straight before and nothing but the resolution of
its encoder (about 1e-4 rad) keeps it from pointing exactly the wrong way. So there are two ways to ask no more of the steering
than it can: to be slow where a caster may turn round (`turning_speed`), or to accelerate from rest so gently that after these
offsets the robot is no faster than that (`turning_acceleration`).
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.robot_description import DRIVE, STEER, FloatArray, RobotDescription

# Of the limits of joint speed: what is left is for the controller, for slip and for a robot that is not quite as described.
SPEED_SHARE = 0.6
# Of the limits of torque and friction, likewise; friction and slopes come on top of what accelerates the robot.
FORCE_SHARE = 0.3
# A caster has turned round after this way, in units of its offset: ln(2 / 1e-4).
WAY_TO_TURN_ROUND = 10.0
STANDARD_GRAVITY = 9.81  # [m/s^2]


@dataclasses.dataclass(frozen=True)
class MotionRange:
    """What a robot can follow, in terms of its fastest wheel centre.

    Attributes:
        lever: distance of the outermost wheel centre from base_link's origin [m]; turning at omega moves it at omega lever.
        rolling_speed: speed of a wheel centre whose caster trails already [m/s].
        turning_speed: speed of a wheel centre whose caster may have to turn round [m/s].
        acceleration: of a wheel centre, along and across its heading, by torque and friction [m/s^2].
        turning_acceleration: from rest to `rolling_speed`, with time for every caster to turn round on the way [m/s^2].
    """

    lever: float
    rolling_speed: float
    turning_speed: float
    acceleration: float
    turning_acceleration: float

    @classmethod
    def of_robot(cls, robot: RobotDescription) -> MotionRange:
        """Return the range of a robot.

        Raises:
            KinematicsError: a caster without offset, which cannot be steered by rolling.
        """
        robot.require_torque_control()
        b_x, b_y = np.abs(robot.caster_offset).T
        rolling = SPEED_SHARE * np.min(robot.speed_limit[:, DRIVE] * robot.wheel_radius / (1.0 + b_y / b_x))
        inertia = _joint_inertia(robot)
        turning = min(
            rolling,
            SPEED_SHARE * np.min(robot.speed_limit[:, STEER] * b_x),
            np.sqrt(FORCE_SHARE * np.min(robot.torque_limit / _turning_torque(robot, inertia))),
        )
        reach = np.hypot(*robot.steer_axis.T)
        yaw_inertia = robot.chassis.inertia_zz + robot.chassis.mass * math.hypot(*robot.chassis.com[:2]) ** 2
        yaw_inertia += sum(c.module.mass * d**2 + c.module.inertia_zz for c, d in zip(robot.casters, reach))
        mass = robot.total_mass / robot.n
        # A turning robot feels at its wheels like this mass at each of them.
        turned_mass = yaw_inertia / np.sum(reach**2)
        acceleration = FORCE_SHARE * _wheel_acceleration(robot, inertia, max(mass, turned_mass))
        return cls(
            lever=float(np.max(reach + np.hypot(b_x, b_y))),
            rolling_speed=float(rolling),
            turning_speed=float(turning),
            acceleration=acceleration,
            turning_acceleration=min(acceleration, float(turning**2 / (2.0 * WAY_TO_TURN_ROUND * np.max(b_x)))),
        )


def _joint_inertia(robot: RobotDescription) -> FloatArray:
    """Return rotors, wheels and forks as the joints feel them, without what they carry, (n, 2, 2) [kg m^2]."""
    inertia = robot.armature.copy()
    inertia[:, DRIVE, DRIVE] += [c.wheel.inertia_axle for c in robot.casters]
    inertia[:, STEER, STEER] += [c.module.inertia_zz for c in robot.casters]
    return inertia


def _turning_torque(robot: RobotDescription, inertia: FloatArray) -> FloatArray:
    """Return a bound of the joint torques (n, 2) that turn a caster round at 1 m/s [N m]; they grow with v^2."""
    b_x, b_y = np.abs(robot.caster_offset).T
    steer_acceleration = 1.0 / (2.0 * b_x**2)
    roll_acceleration = (1.0 / b_x + b_y * steer_acceleration) / robot.wheel_radius
    torque: FloatArray = np.einsum("nij,nj->ni", np.abs(inertia), np.stack([roll_acceleration, steer_acceleration], axis=1))
    return torque


def _wheel_acceleration(robot: RobotDescription, inertia: FloatArray, mass: float) -> float:
    """Return what the weakest caster can accelerate [m/s^2] with `mass` [kg] on it, by drive, steering and friction."""
    lever = np.stack([robot.wheel_radius, np.abs(robot.caster_offset[:, 0])], axis=1)
    by_torque = np.min(robot.torque_limit / lever / (mass + np.diagonal(inertia, axis1=1, axis2=2) / lever**2))
    mu_p = min(robot.contact.mu_p, robot.contact.lateral.mu_p)
    by_friction = mu_p * STANDARD_GRAVITY * robot.total_mass / robot.n / mass
    return float(min(by_torque, by_friction))

"""How fast a robot can be asked to move, whatever its casters point at: from its limits of speed, torque and friction.

The wheel centre of caster i moves with the velocity v of the chassis there. The caster follows slip-free with the steering
rate phi_dot = -v_across / b_x and the roll rate rho_dot = (v_along - b_y phi_dot) / r, (3.25) [Li2009]. Over all headings

    max |phi_dot| = v / |b_x|,      max |rho_dot| <= v (1 + |b_y / b_x|) / r,

the first while the caster turns round. It has turned round, whatever it pointed at, after a way of a few offsets (six: from
within 0.5 % of the wrong way round). So a robot may be faster than its steering in two ways: slow while a caster may still
turn round (`turning_speed`), or with so little acceleration that after these offsets it is still no faster than that
(`turning_acceleration`).
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
# A caster has turned round after this way, in units of its offset: ln(2 / 0.005).
WAY_TO_TURN_ROUND = 6.0
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
        turning = min(rolling, SPEED_SHARE * np.min(robot.speed_limit[:, STEER] * b_x))
        reach = np.hypot(*robot.steer_axis.T)
        inertia = robot.chassis.inertia_zz + robot.chassis.mass * math.hypot(*robot.chassis.com[:2]) ** 2
        inertia += sum(c.module.mass * d**2 + c.module.inertia_zz for c, d in zip(robot.casters, reach))
        mass = robot.total_mass / robot.n
        # A turning robot feels at its wheels like this mass at each of them.
        turned_mass = inertia / np.sum(reach**2)
        acceleration = FORCE_SHARE * _wheel_acceleration(robot, max(mass, turned_mass))
        return cls(
            lever=float(np.max(reach + np.hypot(b_x, b_y))),
            rolling_speed=float(rolling),
            turning_speed=float(turning),
            acceleration=acceleration,
            turning_acceleration=min(acceleration, float(turning**2 / (2.0 * WAY_TO_TURN_ROUND * np.max(b_x)))),
        )


def _wheel_acceleration(robot: RobotDescription, mass: float) -> float:
    """Return what the weakest caster can accelerate [m/s^2] with `mass` [kg] on it, by drive, steering and friction."""
    lever: FloatArray = np.stack([robot.wheel_radius, np.abs(robot.caster_offset[:, 0])], axis=1)
    inertia = robot.armature[:, [DRIVE, STEER], [DRIVE, STEER]].copy()
    inertia[:, DRIVE] += [c.wheel.inertia_axle for c in robot.casters]
    inertia[:, STEER] += [c.module.inertia_zz for c in robot.casters]
    by_torque = np.min(robot.torque_limit / lever / (mass + inertia / lever**2))
    mu_p = min(robot.contact.mu_p, robot.contact.lateral.mu_p)
    by_friction = mu_p * STANDARD_GRAVITY * robot.total_mass / robot.n / mass
    return float(min(by_torque, by_friction))

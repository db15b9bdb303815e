"""How a wanted twist is approached: within limits of acceleration, of the joints, and of how hard casters may turn round.

The reference twist V_d moves straight towards the wanted one, scaled as a whole so that its direction is kept. It is
slowed down

* where a joint would turn faster than a part of its limit: B^-1 A V_d;
* where a caster has to turn far. A wheel dragged at the speed v, at the angle theta from where it will trail, steers by
  itself:

      phi_dot = (v / b) sin theta,      phi_ddot = v_dot sin theta / b - (v / b)^2 sin theta cos theta

  On its way round it passes the worst angle, where |sin theta cos theta| = 1/2. So beyond 45 degrees v stays below
  b sqrt(2 alpha), and nearer below b sqrt(alpha / |sin theta cos theta|): the turn is planned for before it begins, and the
  steering acceleration stays within alpha.

At a stop V_d goes to zero along a straight line and stays there: no wheel is asked to straighten or to flip.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.differential_kinematics import joint_matrix_blocks
from pcw_description.robot_description import STEER, FloatArray, RobotDescription

from .controller_interface import ControllerParameters, parameter
from .quintic_trajectory import MotionLimits

# Part of the steering torque that a caster may use up for turning round; the rest is for the robot.
STEERING_SHARE = 0.5


@dataclasses.dataclass(frozen=True)
class MotionParameters(ControllerParameters):
    """What every controller that follows a twist has in common.

    Attributes:
        joint_speed_fraction: the reference twist is slowed down where a joint would turn faster than this part of its
            limit. A caster that turns round is the usual cause: it steers at up to v/b.
        steer_acceleration: largest acceleration at which a caster is made to turn round [rad/s^2]; 0 derives it: half of the
            steering torque, on the inertia of fork, rotor and the caster's share of the robot.
        limits: limits of the reference when a twist is followed.
    """

    joint_speed_fraction: float = parameter(
        0.8, "1", "the reference uses this part of the speed limits", above=0.0, maximum=1.0
    )
    steer_acceleration: float = parameter(
        0.0, "rad/s^2", "largest acceleration at which a caster is made to turn round; 0 derives it", maximum=1e4
    )
    limits: MotionLimits = dataclasses.field(default_factory=lambda: MotionLimits(1.5, 0.5, 3.0, 1.5))


def derived_steer_acceleration(robot: RobotDescription) -> float:
    """Return what half of the steering torque does to the slowest caster [rad/s^2]."""
    share = robot.total_mass / robot.n
    inertia = robot.armature[:, STEER, STEER] + [c.module.inertia_zz for c in robot.casters]
    inertia = inertia + share * robot.caster_offset[:, 0] ** 2
    return float(np.min(STEERING_SHARE * robot.torque_limit[:, STEER] / inertia))


class ReferenceMotion:
    """The reference twist of one robot."""

    def __init__(self, robot: RobotDescription, parameters: MotionParameters) -> None:
        limits = parameters.limits
        B_inverse: FloatArray = np.linalg.inv(joint_matrix_blocks(robot)).astype(np.float64)
        # What `towards_kernel` takes last.
        self.numbers = (
            B_inverse, robot.speed_limit * parameters.joint_speed_fraction, robot.caster_offset[:, 0].copy(),
            np.array(
                [
                    parameters.joint_speed_fraction, parameters.steer_acceleration or derived_steer_acceleration(robot),
                    limits.speed, limits.acceleration, limits.yaw_rate, limits.yaw_acceleration,
                ]
            ),
        )  # fmt: skip

    def towards(
        self, reference_twist: FloatArray, target: FloatArray, A: FloatArray, dt: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the next reference twist (3,) and its derivative (3,) on the way to a target (3,), with A (2n, 3)."""
        V_d, V_dot_d = towards_kernel(reference_twist, target, A, dt, *self.numbers)
        return V_d, V_dot_d


@compiled
def towards_kernel(reference, target, A, dt, B_inverse, speed_limit, offset, numbers):  # type: ignore[no-untyped-def]
    """As `ReferenceMotion.towards`; one call in every control cycle."""
    fraction, alpha, speed, acceleration, yaw_rate, yaw_acceleration = (
        numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5],
    )  # fmt: skip
    wanted = target * _shrink(target, speed, yaw_rate)
    wanted = wanted / max(1.0, largest_joint_speed_kernel(A, wanted, B_inverse, speed_limit))
    wanted = wanted / max(1.0, _hardest_turn(A, wanted, offset, alpha))
    change = wanted - reference
    change = change * _shrink(change, acceleration * dt, yaw_acceleration * dt)
    V_d = reference + change
    # A caster may turn round in less time than the deceleration allows; then the limit of the joint comes first.
    V_d = V_d / max(1.0, largest_joint_speed_kernel(A, V_d, B_inverse, speed_limit) * fraction)
    change = V_d - reference
    V_dot_d = change / dt * _shrink(change, acceleration * dt, yaw_acceleration * dt)
    return V_d, V_dot_d


@compiled
def largest_joint_speed_kernel(A, twist, B_inverse, speed_limit):  # type: ignore[no-untyped-def]
    """Return the largest of the joint speeds B^-1 A V relative to their limits (n, 2) [1]; one call in a control cycle."""
    largest = 0.0
    for i in range(len(B_inverse)):
        along = A[2 * i, 0] * twist[0] + A[2 * i, 1] * twist[1] + A[2 * i, 2] * twist[2]
        across = A[2 * i + 1, 0] * twist[0] + A[2 * i + 1, 1] * twist[1] + A[2 * i + 1, 2] * twist[2]
        for j in range(2):
            speed = abs(B_inverse[i, j, 0] * along + B_inverse[i, j, 1] * across)
            largest = max(largest, speed / speed_limit[i, j])
    return largest


@compiled
def _hardest_turn(A, twist, offset, alpha):  # type: ignore[no-untyped-def]
    """Return the largest speed of a wheel relative to the one at which its turning round stays within alpha."""
    hardest = 0.0
    for i in range(len(offset)):
        along = A[2 * i, 0] * twist[0] + A[2 * i, 1] * twist[1] + A[2 * i, 2] * twist[2]
        across = A[2 * i + 1, 0] * twist[0] + A[2 * i + 1, 1] * twist[1] + A[2 * i + 1, 2] * twist[2]
        if offset[i] > 0.0:
            along = -along  # a leading wheel trails when it rolls backwards
        squared = along * along + across * across
        if squared == 0.0:
            continue
        if along > abs(across):
            product = along * abs(across) / squared
        else:
            product = 0.5
        hardest = max(hardest, math.sqrt(squared * product / alpha) / abs(offset[i]))
    return hardest


@compiled
def _shrink(twist, linear, angular):  # type: ignore[no-untyped-def]
    """Return the factor up to 1 that brings the translation within `linear` and the turn within `angular`."""
    return 1.0 / max(1.0, math.hypot(twist[0], twist[1]) / linear, abs(twist[2]) / angular)

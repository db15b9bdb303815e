"""How much of the friction under its wheels a motion needs, and motions that need no more than a part of it.

No way to share a force makes more of it than the ground gives, and a wheel that gives all of its hold creeps at its critical
slip ratio: with the part u of it, at

    lambda = lambda_p (1 - sqrt(1 - u^2)) / u                                    from (3.47)

which is 0.27 lambda_p at u = 1/2 and lambda_p at u = 1. So what is asked for is limited before it is shared. The need of a
motion is the least u with which its wrench can be made,

    u = min s  subject to  A^T F_con = Lambda V_dot + theta,  |F_i| <= s mu_i F_zi        `friction_optimal_forces`

for wheels that trail the motion. On the same path it falls with the square of the pace.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.augmented_object_model import AugmentedObjectModel
from pcw_description.differential_kinematics import wheel_jacobian
from pcw_description.robot_description import FloatArray, RobotDescription

from .errors import ControlError
from .force_distribution import friction_optimal_forces
from .quintic_trajectory import MotionLimits, QuinticTrajectory, TrajectoryPoint, plan_point_to_point
from .wheel_loads import WheelLoads

# Half of what the ground is believed to hold: twice too high an estimate of friction is then no loss of traction yet.
GROUND_SHARE = 0.5
_INSTANTS = 33  # at which a trajectory is looked at
_ROUNDS = 4  # a node plans while it drives: some 10 ms each at most
_SLACK, _UNUSED = 1e-3, 0.05  # of the share: beyond it, and left of it


class FrictionBudget:
    """The needs of one robot.

    Args:
        robot: the robot.

    Raises:
        KinematicsError: a caster without offset, whose steering torque makes no side force.
    """

    def __init__(self, robot: RobotDescription) -> None:
        robot.require_torque_control()
        self._robot = robot
        self._model, self._loads = AugmentedObjectModel(robot), WheelLoads(robot)

    def use(
        self, point: TrajectoryPoint, friction: FloatArray | None = None, normal_force: FloatArray | None = None
    ) -> float:
        """Return the part u of friction that the motion at a point of a trajectory needs [1]; above 1 it cannot be had.

        Args:
            point: pose, velocity and acceleration in odom.
            friction: peak friction coefficient under each wheel (n,); None is that of the robot's ground.
            normal_force: measured loads (n,) [N]; None computes them.
        """
        c, s = math.cos(point.pose[2]), math.sin(point.pose[2])
        R_T = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        V, acceleration = R_T @ point.velocity, R_T @ point.acceleration
        V_dot = acceleration - np.array([-V[2] * V[1], V[2] * V[0], 0.0])
        steer_angle = self._trailing(V, acceleration)
        A = wheel_jacobian(self._robot, steer_angle)
        inertia, bias = self._model.evaluate(steer_angle, V)
        limit = self._loads.traction_limit(steer_angle, acceleration, friction, normal_force)
        return friction_optimal_forces(A, inertia @ V_dot + bias, limit).use

    def largest_use(
        self, trajectory: QuinticTrajectory, friction: FloatArray | None = None, normal_force: FloatArray | None = None
    ) -> float:
        """Return the largest need along a trajectory [1]; see `use`."""
        times = np.linspace(0.0, trajectory.duration, _INSTANTS)
        return max(self.use(trajectory.sample(float(time)), friction, normal_force) for time in times)

    def _trailing(self, V: FloatArray, acceleration: FloatArray) -> FloatArray:
        """Return the headings (n,) of wheels that trail the motion, at rest the one that is about to begin."""
        x, y = self._robot.steer_axis.T
        along, across = V[0] - V[2] * y, V[1] + V[2] * x
        resting = np.hypot(along, across) < 1e-6
        along = np.where(resting, acceleration[0] - acceleration[2] * y, along)
        across = np.where(resting, acceleration[1] + acceleration[2] * x, across)
        # A wheel ahead of its axis trails when it rolls backwards.
        behind = np.where(self._robot.caster_offset[:, 0] > 0.0, -1.0, 1.0)
        headings: FloatArray = np.arctan2(behind * across, behind * along)
        return headings


def plan_within_friction(
    budget: FrictionBudget,
    start: TrajectoryPoint,
    goal: TrajectoryPoint,
    limits: MotionLimits,
    share: float = GROUND_SHARE,
    friction: FloatArray | None = None,
    normal_force: FloatArray | None = None,
) -> QuinticTrajectory:
    """Return the quintic of `plan_point_to_point` with its accelerations as low as a share of friction asks for.

    A robot that is under way and would have to brake harder than the share allows gets the trajectory that needs least of
    those that were tried.

    Args:
        budget: of the robot.
        start, goal, limits: see `plan_point_to_point`.
        share: part of the friction that may be needed, above 0 to 1.
        friction, normal_force: see `FrictionBudget.use`.

    Raises:
        ControlError: as `plan_point_to_point`, or a share that is not allowed.
    """
    if not 0.0 < share <= 1.0:
        raise ControlError(f"share = {share!r} is not allowed; allowed: above 0, at most 1")
    trajectory = plan_point_to_point(start, goal, limits)
    gentlest, least, fastest = trajectory, math.inf, None
    for count in range(_ROUNDS):
        if trajectory.duration == 0.0:
            return trajectory
        need = budget.largest_use(trajectory, friction, normal_force)
        if need < least:
            gentlest, least = trajectory, need
        if need <= share * (1.0 + _SLACK):
            if fastest is None or trajectory.duration < fastest.duration:
                fastest = trajectory
            if count == 0 or need >= share * (1.0 - _UNUSED):
                break
        # With less acceleration less load shifts: the need falls by more than the acceleration, and some is given back.
        limits = _slower(trajectory, limits, share / need)
        try:
            trajectory = plan_point_to_point(start, goal, limits)
        except ControlError:
            break  # the speed at the start leaves no way that is as gentle
    return fastest or gentlest


def _slower(trajectory: QuinticTrajectory, limits: MotionLimits, part: float) -> MotionLimits:
    """Return limits of acceleration that are this part of what the trajectory has."""
    times = np.linspace(0.0, trajectory.duration, 8 * _INSTANTS)
    points = np.array([trajectory.sample(float(time)).acceleration for time in times])
    along, turning = float(np.hypot(points[:, 0], points[:, 1]).max()), float(np.abs(points[:, 2]).max())
    return dataclasses.replace(
        limits,
        acceleration=max(min(limits.acceleration, along) * part, 1e-6),
        yaw_acceleration=max(min(limits.yaw_acceleration, turning) * part, 1e-6),
    )

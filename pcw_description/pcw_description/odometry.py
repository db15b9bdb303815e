"""Both odometries of section 3.2.3: by the displacement model (3.31)-(3.32) and by the differential model (3.33)."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from .compiled import compiled
from .differential_kinematics import forward_kinematics_kernel
from .displacement_kinematics import forward_displacement_kernel
from .errors import KinematicsError
from .robot_description import STEER, FloatArray, RobotDescription

METHODS = ("differential", "displacement")


@dataclasses.dataclass(frozen=True)
class OdometryParameters:
    """How odometry is computed.

    Attributes:
        method: "differential" (3.33) or "displacement" (3.31).
        residual_memory: number of updates over which the redundant residual is averaged for the covariance.
    """

    method: str = "differential"
    residual_memory: float = 50.0

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            KinematicsError: unknown method or a memory below one update.
        """
        if self.method not in METHODS:
            raise KinematicsError(f"odometry method {self.method!r} is not allowed; allowed: {', '.join(METHODS)}")
        if not self.residual_memory >= 1.0:
            raise KinematicsError(f"residual_memory {self.residual_memory!r} is not allowed; allowed: at least 1 update")


@dataclasses.dataclass(frozen=True)
class OdometryState:
    """State of the odometry.

    Attributes:
        joint_position: last joint angles (n, 2) [rad]; None before the first measurement.
        pose: pose of base_link in odom (x, y, yaw) [m, m, rad].
        pose_covariance: covariance of the pose in odom (3, 3).
        residual_variance: averaged variance of the redundant residual per component [m^2] of one update.
        updates: number of updates averaged so far.
    """

    joint_position: FloatArray | None
    pose: FloatArray
    pose_covariance: FloatArray
    residual_variance: float = 0.0
    updates: int = 0


@dataclasses.dataclass(frozen=True)
class OdometryOutput:
    """What one update gives.

    Attributes:
        twist: twist of base_link in base_link (3,), mean over the sample.
        twist_covariance: its covariance (3, 3), from the redundant residual.
        slip: joint-consistency residual of the sample (n, 2) [m/s].
    """

    twist: FloatArray
    twist_covariance: FloatArray
    slip: FloatArray


def initial_state(pose: FloatArray | None = None) -> OdometryState:
    """Return the state before the first measurement, at a known pose or the origin."""
    start = np.zeros(3) if pose is None else np.array(pose, dtype=float)
    return OdometryState(None, start, np.zeros((3, 3)))


@compiled
def _integrate(pose, covariance, increment, increment_covariance):  # type: ignore[no-untyped-def]
    """Return pose and covariance after a body increment (3,): the exponential map of SE(2), (3.29)-(3.30)."""
    yaw = pose[2]
    angle = increment[2]
    if abs(angle) < 1e-6:
        a, b = 1.0 - angle * angle / 6.0, 0.5 * angle
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle
    dx = a * increment[0] - b * increment[1]
    dy = b * increment[0] + a * increment[1]
    c, s = math.cos(yaw), math.sin(yaw)
    moved = np.empty(3)
    moved[0] = pose[0] + c * dx - s * dy
    moved[1] = pose[1] + s * dx + c * dy
    moved[2] = yaw + angle
    by_pose = np.eye(3)
    by_pose[0, 2] = -(moved[1] - pose[1])
    by_pose[1, 2] = moved[0] - pose[0]
    middle_c, middle_s = math.cos(yaw + 0.5 * angle), math.sin(yaw + 0.5 * angle)
    by_increment = np.zeros((3, 3))
    by_increment[0, 0], by_increment[0, 1] = middle_c, -middle_s
    by_increment[1, 0], by_increment[1, 1] = middle_s, middle_c
    by_increment[2, 2] = 1.0
    grown = by_pose @ covariance @ by_pose.T + by_increment @ increment_covariance @ by_increment.T
    return moved, grown


@compiled
def _differential_update(steer_axis, caster_offset, wheel_radius, steer_angle, step, pose, covariance, variance, weight):  # type: ignore[no-untyped-def]
    """One update by (3.33), in one compiled call because a control loop runs it every cycle."""
    increment, residual, normal_inverse = forward_kinematics_kernel(
        steer_axis, caster_offset, wheel_radius, steer_angle, step
    )
    return _finish_update(increment, increment, residual, normal_inverse, pose, covariance, variance, weight)


@compiled
def _displacement_update(steer_axis, caster_offset, wheel_radius, steer_angle, step, pose, covariance, variance, weight):  # type: ignore[no-untyped-def]
    """One update by (3.31); its displacement is the end point of the motion, so the logarithm gives the increment."""
    end, residual = forward_displacement_kernel(steer_axis, caster_offset, wheel_radius, steer_angle, step)
    _, _, normal_inverse = forward_kinematics_kernel(steer_axis, caster_offset, wheel_radius, steer_angle, step)
    angle = end[2]
    half = 0.5 * angle
    scale = 1.0 - half * half / 3.0 if abs(angle) < 1e-6 else half / math.tan(half)
    increment = np.empty(3)
    increment[0] = scale * end[0] + half * end[1]
    increment[1] = -half * end[0] + scale * end[1]
    increment[2] = angle
    in_wheel_frame = np.empty_like(residual)
    for i in range(len(steer_angle)):
        c, s = math.cos(steer_angle[i]), math.sin(steer_angle[i])
        in_wheel_frame[i, 0] = c * residual[i, 0] + s * residual[i, 1]
        in_wheel_frame[i, 1] = -s * residual[i, 0] + c * residual[i, 1]
    return _finish_update(increment, increment, in_wheel_frame, normal_inverse, pose, covariance, variance, weight)


@compiled
def _finish_update(increment, twist, residual, normal_inverse, pose, covariance, variance, weight):  # type: ignore[no-untyped-def]
    n = len(residual)
    fresh = 0.0
    for i in range(n):
        fresh += residual[i, 0] * residual[i, 0] + residual[i, 1] * residual[i, 1]
    # 2n measured velocities, 3 estimated: the rest of the freedom tells the noise.
    fresh /= 2 * n - 3
    variance = variance + weight * (fresh - variance)
    increment_covariance = variance * normal_inverse
    moved, grown = _integrate(pose, covariance, increment, increment_covariance)
    return moved, grown, variance, twist, increment_covariance, residual


def update(
    robot: RobotDescription,
    parameters: OdometryParameters,
    state: OdometryState,
    joint_position: FloatArray,
    dt: float,
) -> tuple[OdometryState, OdometryOutput]:
    """Advance the odometry by one measurement, (3.29)-(3.33).

    The matrices are taken at the middle of the sample, which makes the increment second-order accurate. Its covariance is
    s^2 (A^T A)^-1 with s^2 the averaged redundant residual: nothing is typed in.

    Args:
        robot: the robot.
        parameters: method and averaging.
        state: state after the previous measurement.
        joint_position: joint angles (n, 2) [rad], continuous (not wrapped).
        dt: measured time since the previous measurement [s].

    Returns:
        New state and output. The first measurement only stores the angles and gives a zero twist.

    Raises:
        KinematicsError: dt is not positive, or the angles are not finite; the caller keeps its state.
    """
    if not np.isfinite(joint_position).all():
        raise KinematicsError("joint_position holds NaN or infinity; allowed: finite angles in rad")
    if state.joint_position is None:
        first = dataclasses.replace(state, joint_position=joint_position.copy())
        return first, OdometryOutput(np.zeros(3), np.zeros((3, 3)), np.zeros((robot.n, 2)))
    if not dt > 0.0:
        raise KinematicsError(f"dt = {dt!r} s is not allowed; allowed: above 0, measured from stamps")
    step = joint_position - state.joint_position
    updates = state.updates + 1
    weight = max(1.0 / updates, 1.0 / parameters.residual_memory)
    if parameters.method == "differential":
        advance, heading = _differential_update, state.joint_position[:, STEER] + 0.5 * step[:, STEER]
    else:
        advance, heading = _displacement_update, state.joint_position[:, STEER].copy()
    pose, covariance, variance, increment, increment_covariance, residual = advance(
        robot.steer_axis, robot.caster_offset, robot.wheel_radius, heading, step,
        state.pose, state.pose_covariance, state.residual_variance, weight,
    )
    following = OdometryState(joint_position.copy(), pose, covariance, variance, updates)
    return following, OdometryOutput(increment / dt, increment_covariance / dt**2, residual / dt)

"""Whether the wheels of a recording were off the ground: they turn, and the robot stands.

A tracked pose or a gyro says so. Where neither was recorded the torques do, which are far too small to move such a robot. If
they were only in other units the robot would move in proportion to them.
"""

from __future__ import annotations

import numpy as np

from pcw_description.recording import Recording
from pcw_description.robot_description import DRIVE, STEER, RobotDescription

from ...plants.true_robot import as_it_really_is
from ..regression.regression_problem import FloatArray, RegressionProblem
from .rolling_model import WRENCH, ModelNumbers, twists

# Speeds are taken over this time [s]: trackers are noisy, and no manoeuvre turns round as often.
OVER = 0.4
# A robot stands whose speed is this part of that of its wheels. Wheels on the ground never spin so much all the time.
STANDING = 0.05
LEAST_SPEED = 0.02  # [m/s], of wheels that turn
# A gyro tells only where wheels would turn the robot by at least this part of their own speed.
TURNING = 0.2
# Torques turn wheels alone that bring this part of the force to the ground which would move the robot, and in proportion to
# which it does not move.
IDLE, IN_PROPORTION = 0.2, 0.95


def wheels_off_ground(robot: RobotDescription, recording: Recording) -> bool:
    """Return whether wheels turned that moved no robot, by the tracked pose or else by the gyro; False where neither is."""
    joints, numbers = recording.joint_states, ModelNumbers.of(as_it_really_is(robot))
    whole = np.isfinite(joints.position).all(axis=(1, 2))
    if np.count_nonzero(whole) < 2:
        return False
    stamp, position = joints.stamp[whole], joints.position[whole]
    time = np.arange(stamp[0], stamp[-1], OVER)
    if len(time) < 4:
        return False
    angle = np.stack([_sampled(time, stamp, column) for column in position.reshape(len(position), -1).T], axis=1)
    angle = angle.reshape(len(time), robot.n, 2)
    rate = np.diff(angle, axis=0) / OVER
    middle = np.ascontiguousarray(0.5 * (angle[1:] + angle[:-1])[:, :, STEER])
    wheels = _size(numbers.radius * rate[:, :, DRIVE], numbers.caster_offset[:, 0] * rate[:, :, STEER])
    if wheels < LEAST_SPEED:
        return False
    reach = float(np.max(np.linalg.norm(numbers.steer_axis, axis=1)))
    truth, imu = recording.ground_truth, recording.imu
    if truth is not None and len(truth.stamp) > 1:
        x, y, yaw = (_sampled(time, truth.stamp, column) for column in (*truth.pose[:, :2].T, np.unwrap(truth.pose[:, 2])))
        return _size(np.diff(x), np.diff(y), reach * np.diff(yaw)) / OVER < STANDING * wheels
    turning = twists(numbers, middle, rate)[0][:, 2]
    if imu is None or len(imu.stamp) < 2 or reach * _size(turning) < TURNING * wheels:
        return False
    # Over the same times the mean of a gyro is what it turned by.
    turned = np.concatenate([[0.0], np.cumsum(np.diff(imu.stamp) * 0.5 * (imu.gyro[1:, 2] + imu.gyro[:-1, 2]))])
    sensed = np.diff(_sampled(time, imu.stamp, turned)) / OVER
    return _size(sensed - np.median(sensed)) < STANDING * _size(turning)


def wheels_turn_alone(problem: RegressionProblem) -> bool:
    """Return whether torques move nothing but the wheels; False where sensors say whether the robot moves."""
    names = [channel.name for channel in problem.channels]
    if names[: len(WRENCH)] != list(WRENCH) or {"gyro", "pose/x"} & set(names):
        return False
    brought = problem.measured[:, : len(WRENCH)]
    needed = brought - problem.residual[:, : len(WRENCH)]
    size = np.sqrt(np.mean(needed**2, axis=0))
    if not size.all():
        return False
    brought, needed = brought / size, needed / size
    in_proportion = abs(np.vdot(brought, needed)) / max(float(np.linalg.norm(brought) * np.linalg.norm(needed)), 1e-300)
    return bool(np.linalg.norm(brought) < IDLE * np.linalg.norm(needed) and in_proportion < IN_PROPORTION)


def _sampled(time: FloatArray, stamp: FloatArray, values: FloatArray) -> FloatArray:
    """Values at other times; NaN, which is no speed at all, where none was measured."""
    known = np.isfinite(values)
    return np.interp(time, stamp[known], values[known]) if known.any() else np.full_like(time, np.nan)


def _size(*values: FloatArray) -> float:
    """Root mean square of the length of vectors with such components."""
    return float(np.sqrt(sum(np.mean(component**2) for component in values)))

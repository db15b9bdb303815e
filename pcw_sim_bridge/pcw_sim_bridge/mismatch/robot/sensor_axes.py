"""Whether IMU and tracker move as the wheels do: sensors that are mounted upside down, turned, or named by other axes.

What a sensor and the wheels say of the motion is averaged over the same short times, so that neither noise nor a clock that is
a little ahead matters, and held against one another. Speeds and accelerations in the plane are complex numbers, and the factor
between two of them, c = sum(s w*) / sum(w w*), has the angle by which one is turned against the other.
"""

from __future__ import annotations

import math

import numpy as np

from pcw_description.recording import Recording
from pcw_description.robot_description import RobotDescription

from ...plants.true_robot import as_it_really_is
from ..regression.regression_problem import FloatArray
from .robot_motion import tracked_place
from .rolling_model import ModelNumbers, at_place, twists

WINDOW = 0.2  # [s], over which motion is averaged
LEAST_WINDOWS = 50
ALIKE = 0.8  # least correlation of what is the same motion, but for its sign or its axes
BETTER = 0.2  # by which a mirrored motion has to correlate better
TURNED = math.radians(30.0)  # no description is off by as much, and no slip makes it seem so
SCALE = 3.0  # of lengths, either way; a unit is


def unlike_axes(robot: RobotDescription, recording: Recording) -> list[str]:
    """Return a sentence on everything that a sensor says otherwise than the wheels, none where there is nothing.

    Args:
        robot: the casters of which are all recorded.
        recording: opened with it.
    """
    stamp, way = _wheels(robot, recording)
    imu, truth = recording.imu, recording.ground_truth
    found: list[str] = []
    for series in (imu, truth):
        if series is None or len(series.stamp) < 2:
            continue
        begin, end = max(stamp[0], series.stamp[0]), min(stamp[-1], series.stamp[-1])
        edges = np.arange(begin, end, WINDOW)
        if len(edges) < LEAST_WINDOWS:
            continue
        wheels = _means(edges, stamp, way)
        if series is imu:
            sensed = np.column_stack([imu.acceleration[:, :2], imu.gyro[:, 2]])
            steps = 0.5 * (sensed[1:] + sensed[:-1]) * np.diff(imu.stamp)[:, None]
            found += _of_imu(robot, wheels, _means(edges, imu.stamp, _summed(steps)))
        elif truth is not None:
            pose = np.stack([np.interp(edges, truth.stamp, column) for column in truth.pose.T], axis=1)
            found += _of_tracker(robot, wheels, pose)
    return found


def _wheels(robot: RobotDescription, recording: Recording) -> tuple[FloatArray, FloatArray]:
    """Stamps (T,) and the way of the base (T, 3) by its wheels in its own frame, where all of them were read.

    Nothing is divided by the time between two stamps, which may be next to none.
    """
    joints, numbers = recording.joint_states, ModelNumbers.of(as_it_really_is(robot))
    whole = np.isfinite(joints.position).all(axis=(1, 2))
    stamp, position = joints.stamp[whole], joints.position[whole]
    if len(stamp) < LEAST_WINDOWS:
        return np.array([0.0, 0.0]), np.zeros((2, 3))
    heading = numbers.headings(0.5 * (position[1:] + position[:-1]))
    return stamp, _summed(twists(numbers, heading, np.diff(position, axis=0))[0])


def _summed(steps: FloatArray) -> FloatArray:
    """Sums (T, K) of steps (T - 1, K), from 0."""
    return np.concatenate([np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)])


def _means(edges: FloatArray, stamp: FloatArray, integral: FloatArray) -> FloatArray:
    """Means (W, K) between edges (W + 1,) of signals with this integral (T, K)."""
    at = np.stack([np.interp(edges, stamp, column) for column in integral.T], axis=1)
    means: FloatArray = np.diff(at, axis=0) / np.diff(edges)[:, None]
    return means


def _of_imu(robot: RobotDescription, wheels: FloatArray, sensed: FloatArray) -> list[str]:
    """What an IMU says otherwise: means (W, 3) of the base's twist, and of acceleration x, y and yaw rate."""
    found = []
    if _turns_back(sensed[:, 2], wheels[:, 2]):
        found.append("imu/data: the gyro turns the other way than the wheels: is it upside down, or its axis another one?")
    imu = robot.sensors.imu
    x, y = (0.0, 0.0) if imu is None else imu.position[:2]
    along = at_place(wheels, np.array([x, y, 0.0]))
    velocity, rate = _complex(along), wheels[:, 2]
    # What a rigid body is accelerated by over two windows, and what was felt in them.
    expected = (velocity[2:] - velocity[:-2]) / (2.0 * WINDOW) + 1j * rate[1:-1] * velocity[1:-1]
    felt = _complex(sensed)
    felt = 0.25 * felt[:-2] + 0.5 * felt[1:-1] + 0.25 * felt[2:]
    what = "imu/data: the accelerometer feels what the wheels do"
    return found + _in_words(what, felt - felt.mean(), expected - expected.mean())


def _of_tracker(robot: RobotDescription, wheels: FloatArray, pose: FloatArray) -> list[str]:
    """What a tracker says otherwise: means (W, 3) of the base's twist, and poses (W + 1, 3) between them."""
    found, moved = [], np.diff(pose, axis=0) / WINDOW
    if _turns_back(moved[:, 2], wheels[:, 2]):
        found.append("ground_truth/odom: it turns the other way than the wheels: is its yaw counted clockwise?")
    yaw = 0.5 * (pose[1:, 2] + pose[:-1, 2])
    own = _complex(moved) * np.exp(-1j * yaw)
    there = _complex(at_place(wheels, tracked_place(robot)))
    return found + _in_words("ground_truth/odom: it moves as the wheels do", own, there, True)


def _complex(values: FloatArray) -> np.ndarray:
    return np.asarray(values[:, 0] + 1j * values[:, 1])


def _turns_back(sensed: FloatArray, wheels: FloatArray) -> bool:
    """Whether a yaw rate (W,) is opposite to that of the wheels."""
    return float(sensed @ wheels) < -ALIKE * float(np.linalg.norm(sensed) * np.linalg.norm(wheels)) < 0.0


def _in_words(what: str, sensed: np.ndarray, wheels: np.ndarray, is_length: bool = False) -> list[str]:
    """What is turned, mirrored or in other units of a motion in the plane (W,) that is the same otherwise."""
    size = float(np.linalg.norm(sensed) * np.linalg.norm(wheels))
    if size == 0.0:
        return []
    turned, mirrored = np.vdot(wheels, sensed), np.vdot(wheels.conj(), sensed)
    if abs(mirrored) > ALIKE * size and abs(mirrored) > abs(turned) + BETTER * size:
        return [f"{what}, but mirrored: is one of its axes named otherwise?"]
    if abs(turned) <= ALIKE * size:
        return []
    angle = float(np.angle(turned))
    if abs(angle) > TURNED:
        turn = f"turned by {math.degrees(angle):.0f} degrees about z"
        return [f"{what}, but {turn}: is it mounted so? Its axes have to be those that the description says"]
    factor = abs(turned) / float(np.linalg.norm(wheels)) ** 2
    if is_length and not 1.0 / SCALE < factor < SCALE:
        return [f"{what}, but {factor:.3g} times as far: is it in metres?"]
    return []

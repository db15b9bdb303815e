"""Recordings of robots that roll without slip, and nothing else: positions of joints and a tracked pose, at a slow rate.

Written with kinematics of their own (the motion of steered wheels from their angles), not with those of the analyser. No
plant of the simulator has wheels without an offset, nor fixed ones.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pcw_description.recording_writer import RecordingWriter
from pcw_description.robot_description import STEER, RobotDescription
from pcw_description.ros_messages import joint_state, odometry

FloatArray = npt.NDArray[np.float64]

RATE = 25.0  # [Hz]
FINE = 20  # steps of the integration per sample
START_NS = 1_000_000_000
ANGLE_NOISE = 5e-4  # [rad], of joints that turn at all


def smooth_signal(time: FloatArray, size: float, slowest: float, rng: np.random.Generator) -> FloatArray:
    """A sum of slow sines (T,) of about a size, all slower than three times `slowest` [rad/s]."""
    found = np.zeros_like(time)
    for factor in (1.0, 1.7, 2.6):
        found += np.sin(factor * slowest * time + rng.uniform(0.0, math.tau)) / factor
    return size * found / 1.5


def tricycle_motion(wheelbase: float, radius: float, duration: float, rng: np.random.Generator) -> tuple[FloatArray, ...]:
    """Joint angles (T, 1, 2) and pose of the axle's middle (T, 3) of a robot that is steered and driven in front."""
    time = np.arange(0.0, duration, 1.0 / (RATE * FINE))
    heading = smooth_signal(time, 0.8, 0.5, rng)
    speed = smooth_signal(time, 0.5, 0.35, rng) + 0.15
    yaw_rate = speed * np.sin(heading) / wheelbase
    pose = _integrated(np.stack([speed * np.cos(heading), np.zeros_like(time), yaw_rate], axis=1))
    roll = _sum(speed / radius)
    return np.stack([roll, heading], axis=1)[::FINE, None], pose[::FINE]


def swerve_motion(robot: RobotDescription, duration: float, rng: np.random.Generator) -> tuple[FloatArray, ...]:
    """Joint angles (T, n, 2) and pose (T, 3) of wheels that are steered on the spot, without offset, to where they go."""
    time = np.arange(0.0, duration, 1.0 / (RATE * FINE))
    # Forwards enough that no wheel has to turn round.
    along, across = 0.5 + smooth_signal(time, 0.15, 0.4, rng), smooth_signal(time, 0.25, 0.3, rng)
    yaw_rate = smooth_signal(time, 0.35, 0.35, rng)
    velocity_x = along[:, None] - yaw_rate[:, None] * robot.steer_axis[:, 1]
    velocity_y = across[:, None] + yaw_rate[:, None] * robot.steer_axis[:, 0]
    heading = np.unwrap(np.arctan2(velocity_y, velocity_x), axis=0)
    roll = _sum(np.hypot(velocity_x, velocity_y) / robot.wheel_radius)
    pose = _integrated(np.stack([along, across, yaw_rate], axis=1))
    return np.stack([roll, heading], axis=2)[::FINE], pose[::FINE]


def axle_motion(robot: RobotDescription, duration: float, rng: np.random.Generator) -> tuple[FloatArray, ...]:
    """Joint angles (T, 2, 2) and pose (T, 3) of two driven wheels beside each other that never steer."""
    time = np.arange(0.0, duration, 1.0 / (RATE * FINE))
    along, yaw_rate = 0.3 + smooth_signal(time, 0.3, 0.35, rng), smooth_signal(time, 0.6, 0.4, rng)
    roll = _sum((along[:, None] - yaw_rate[:, None] * robot.steer_axis[:, 1]) / robot.wheel_radius)
    pose = _integrated(np.stack([along, np.zeros_like(time), yaw_rate], axis=1))
    return np.stack([roll, np.zeros_like(roll)], axis=2)[::FINE], pose[::FINE]


def write(
    path: Path,
    robot: RobotDescription,
    joints: FloatArray,
    pose: FloatArray,
    rng: np.random.Generator,
    steer_offset: dict[str, float] | None = None,
) -> Path:
    """Write joint_states and ground_truth/odom with noise.

    Args:
        robot: as it is described; its tracker says what is tracked, and how well.
        joints: angles (T, n, 2); pose: of base_link (T, 3).
        steer_offset: by how much the reading of a steering is more than its heading [rad].
    """
    tracker = robot.sensors.tracker
    assert tracker is not None
    x, y, yaw = tracker.place
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    tracked = pose + np.stack([c * x - s * y, s * x + c * y, np.full(len(pose), yaw)], axis=1)
    tracked += rng.standard_normal(tracked.shape) * [tracker.position_noise, tracker.position_noise, tracker.yaw_noise]
    read = joints + ANGLE_NOISE * np.any(joints, axis=0) * rng.standard_normal(joints.shape)
    for name, offset in (steer_offset or {}).items():
        read[:, robot.caster_index(name), STEER] += offset
    with RecordingWriter(path) as writer:
        for k, (angles, place) in enumerate(zip(read, tracked, strict=True)):
            stamp = START_NS + round(1e9 * k / RATE)
            writer.write("/joint_states", joint_state(stamp, robot.joint_names, angles))
            writer.write("/ground_truth/odom", odometry(stamp, place, np.zeros(3), child_frame_id="tracked"))
    return path


def _sum(rate: FloatArray) -> FloatArray:
    """Integral (T, ...) of rates by trapezoids, from zero."""
    steps = 0.5 * (rate[1:] + rate[:-1]) / (RATE * FINE)
    return np.concatenate([np.zeros((1, *rate.shape[1:])), np.cumsum(steps, axis=0)])


def _integrated(twist: FloatArray) -> FloatArray:
    """Pose (T, 3) of what moves with a twist (T, 3) in its own axes, from zero."""
    yaw = _sum(twist[:, 2])
    c, s = np.cos(yaw), np.sin(yaw)
    place = _sum(np.stack([c * twist[:, 0] - s * twist[:, 1], s * twist[:, 0] + c * twist[:, 1]], axis=1))
    return np.column_stack([place, yaw])



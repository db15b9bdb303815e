"""What the sensors of a robot report of the truth that a plant computes.

Encoders sit on the motors, so a joint angle is read as N^-1 (2 pi / c) round(c / 2 pi N q), with the gear matrix N and c
counts per turn of the motor: with a steer/drive coupling the resolution of one joint depends on both encoders.

The accelerometer stands at r in base_link and measures what is not gravity,

    a = a_0 + alpha x r + omega x (omega x r) - g.

Effects of the robot's `physics` that falsify a reading act here, between the truth and the noise.

Rates are the caller's business: each function is called when its sensor is due. All noise comes from the `rng` given.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from pcw_description.effects.kinds import EncoderEffect, ImuEffect
from pcw_description.effects.registry import get
from pcw_description.errors import DescriptionError
from pcw_description.robot_description import AXIS_NAMES, FloatArray, RobotDescription, TrackerDescription

from .plants.plant import PlantState

VELOCITY_SOURCES = ("drive", "difference")


@dataclasses.dataclass(frozen=True)
class JointReading:
    """What the drives report, joint side.

    Attributes:
        position: from the encoders (n, 2) [rad].
        velocity: (n, 2) [rad/s].
        effort: measured motor torque (n, 2) [N m].
    """

    position: FloatArray
    velocity: FloatArray
    effort: FloatArray


@dataclasses.dataclass(frozen=True)
class ImuReading:
    """What the IMU reports, axes parallel to base_link.

    Attributes:
        angular_velocity: (3,) [rad/s].
        linear_acceleration: (3,) [m/s^2], gravity included as +9.81 upwards.
    """

    angular_velocity: FloatArray
    linear_acceleration: FloatArray


class Encoders:
    """Encoders and torque measurement of all drives.

    Args:
        robot: the robot.
        velocity_source: "drive": the velocity that a drive's own fast observer reports, which is the truth with
            `sensors.encoders.velocity_noise`; "difference": the difference of two readings over dt, with the same noise
            added, as a driver without such an observer would compute.
    """

    def __init__(self, robot: RobotDescription, velocity_source: str = "drive") -> None:
        if velocity_source not in VELOCITY_SOURCES:
            raise DescriptionError("velocity_source", velocity_source, f"allowed: {', '.join(VELOCITY_SOURCES)}")
        self._sensor = robot.sensors.encoders
        self._gear = robot.gear_matrix
        self._gear_inverse = np.linalg.inv(robot.gear_matrix)
        self._counts_per_radian = np.array([self._sensor.drive_counts, self._sensor.steer_counts]) / math.tau
        self._difference = velocity_source == "difference"
        self._effects: list[tuple[EncoderEffect, list[int], int, Mapping[str, float]]] = []
        for instance in robot.physics:
            effect = get(instance.name)
            if isinstance(effect, EncoderEffect):
                casters = [robot.caster_index(name) for name in instance.target]
                axis = AXIS_NAMES.index(instance.axis or effect.axis)
                self._effects.append((effect, casters, axis, instance.parameters))

    def counts(self, joint_position: FloatArray) -> FloatArray:
        """Return the whole counts (n, 2) of the motors' encoders for joint angles (n, 2) [rad]."""
        motor = np.einsum("nij,nj->ni", self._gear, joint_position)
        return np.round(motor * self._counts_per_radian)

    def position(self, counts: FloatArray) -> FloatArray:
        """Return joint angles (n, 2) [rad] for counts (n, 2)."""
        return np.einsum("nij,nj->ni", self._gear_inverse, counts / self._counts_per_radian)

    def read(
        self, truth: PlantState, previous: JointReading | None, dt: float, rng: np.random.Generator
    ) -> JointReading:
        """Return one reading.

        Args:
            truth: the plant's state.
            previous: the reading before; None for the first, whose velocity by difference is zero.
            dt: time since the reading before [s].
            rng: source of the noise.
        """
        sensor, shape = self._sensor, truth.joint_position.shape
        seen, velocity = truth.motor_position, truth.motor_velocity
        if self._effects:
            seen, velocity = seen.copy(), velocity.copy()
            for effect, casters, axis, parameters in self._effects:
                seen[casters, axis], velocity[casters, axis] = effect.measure(
                    seen[casters, axis], velocity[casters, axis], parameters
                )
        position = self.position(self.counts(seen))
        if self._difference:
            velocity = np.zeros(shape) if previous is None else (position - previous.position) / dt
        return JointReading(
            position=position,
            velocity=velocity + sensor.velocity_noise * rng.standard_normal(shape),
            effort=truth.motor_torque + sensor.torque_noise * rng.standard_normal(shape),
        )


class Imu:
    """The IMU of a robot, axes parallel to base_link.

    Args:
        robot: the robot as it really is; its `physics` hold the IMU's errors.
    """

    def __init__(self, robot: RobotDescription) -> None:
        assert robot.sensors.imu is not None
        self._sensor = robot.sensors.imu
        self._effects = [
            (effect, instance.parameters)
            for instance in robot.physics
            if isinstance(effect := get(instance.name), ImuEffect)
        ]

    def read(self, truth: PlantState, rng: np.random.Generator) -> ImuReading:
        """Return one reading. Of roll and pitch, which are small, no products are taken, and no bouncing on the springs."""
        imu = self._sensor
        r_x, r_y, r_z = imu.position
        a_x, a_y, alpha = truth.acceleration
        omega = truth.twist[2]
        rolling, pitching = truth.swing_acceleration
        # a_0 + alpha x r + omega x (omega x r), written out: np.cross is slow on single vectors.
        acceleration = np.array([
            a_x - alpha * r_y - omega**2 * r_x + pitching * r_z,
            a_y + alpha * r_x - omega**2 * r_y - rolling * r_z,
            rolling * r_y - pitching * r_x,
        ]) - truth.gravity  # fmt: skip
        rate = np.array([*truth.swing_rate, omega])
        for effect, parameters in self._effects:
            rate, acceleration = effect.measure(rate, acceleration, parameters)
        return ImuReading(
            angular_velocity=rate + imu.gyro_noise * rng.standard_normal(3),
            linear_acceleration=acceleration + imu.accelerometer_noise * rng.standard_normal(3),
        )


def read_tracker(tracker: TrackerDescription, truth: PlantState, rng: np.random.Generator) -> FloatArray:
    """Return the pose (x, y, yaw) that a tracker measures (3,) [m, m, rad], of what it tracks."""
    sigma = np.array([tracker.position_noise, tracker.position_noise, tracker.yaw_noise])
    x, y, yaw = tracker.place
    c, s = math.cos(truth.pose[2]), math.sin(truth.pose[2])
    noisy: FloatArray = truth.pose + [c * x - s * y, s * x + c * y, yaw] + sigma * rng.standard_normal(3)
    return noisy

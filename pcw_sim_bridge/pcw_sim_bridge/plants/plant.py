"""What every simulated robot offers, whatever computes it."""

from __future__ import annotations

import dataclasses
import math
from typing import Protocol

import numpy as np

from pcw_description.errors import PcwError
from pcw_description.robot_description import FloatArray, RobotDescription

PLANT_NAMES = ("reduced", "pybullet", "mujoco")


class PlantError(PcwError):
    """A plant that cannot be made or has left what it can compute."""


@dataclasses.dataclass(frozen=True)
class PlantState:
    """The truth at one instant.

    Attributes:
        time: simulated time [s].
        pose: pose of base_link in the world (x, y, yaw), yaw continuous [m, m, rad].
        twist: twist of base_link in base_link (v_x, v_y, omega) [m/s, m/s, rad/s].
        acceleration: acceleration of base_link's origin in base_link, and yaw acceleration (3,) [m/s^2, m/s^2, rad/s^2].
            Of an engine in space the mean over the last two steps: from one to the next they alternate around what a robot
            does, and no accelerometer is as fast.
        gravity: (3,) in base_link, not (0, 0, -g) on a slope, or where the chassis leans on its springs [m/s^2].
        swing_rate, swing_acceleration: roll and pitch of the chassis on its springs, about x and y of base_link (2,)
            [rad/s], [rad/s^2]; the reduced plant knows those over uneven ground and over wheels that give way.
        joint_position: (n, 2) [rad], continuous.
        joint_velocity: (n, 2) [rad/s].
        motor_position, motor_velocity: what the encoders on the motors see, as the joint motion (n, 2) that rigid gears
            would make of it; another than the joints' only behind gears that play or twist.
        motor_torque: torques that the motors gave over the last step, joint side (n, 2) [N m].
        slip: slip velocity at the contacts (n, 2) [m/s].
        contact_force: force of the ground on the wheels in the wheel frames (n, 2) [N].
        normal_force: (n,) [N].
    """

    time: float
    pose: FloatArray
    twist: FloatArray
    acceleration: FloatArray
    gravity: FloatArray
    swing_rate: FloatArray
    swing_acceleration: FloatArray
    joint_position: FloatArray
    joint_velocity: FloatArray
    motor_position: FloatArray
    motor_velocity: FloatArray
    motor_torque: FloatArray
    slip: FloatArray
    contact_force: FloatArray
    normal_force: FloatArray


def gravity_in_base(gravity: FloatArray, yaw: float) -> FloatArray:
    """Return gravity (3,) of the world in the axes of base_link."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([c * gravity[0] + s * gravity[1], -s * gravity[0] + c * gravity[1], gravity[2]])


class Plant(Protocol):
    """A robot on its wheels that takes joint torques."""

    robot: RobotDescription
    dt: float

    def reset(self, pose: FloatArray | None = None, steer_angle: FloatArray | None = None) -> None:
        """Put the robot at rest at a pose (3,), the wheels at headings (n,); time becomes zero."""

    def set_motion(self, twist: FloatArray, joint_position: FloatArray, joint_velocity: FloatArray) -> None:
        """Give the robot a twist (3,) in base_link and its joints angles and rates (n, 2), to go on from there."""

    def step(self, motor_torque: FloatArray, steps: int = 1) -> None:
        """Advance by `steps` steps of dt with joint-side motor torques (n, 2) [N m] held; limits are applied here."""

    def state(self) -> PlantState:
        """Return the truth now."""

    def close(self) -> None:
        """Free what the plant holds."""

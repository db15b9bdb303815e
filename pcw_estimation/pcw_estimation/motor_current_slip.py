"""Slip from motor currents (Ojeda, Cruz, Reina, Borenstein, IEEE Trans. Robotics 22(2), 2006): a baseline.

The more a wheel slips, the more torque its motor needs, and the more current it draws. On a known ground a line serves,

    lambda = c |tau|,      v_x = r rho_dot (1 - lambda),

with c from the friction curve here, where the authors tune it by positions from elsewhere. All-wheel slip is flagged where the
current is as high as the ground allows. Taken as it is published: a torque that accelerates the wheel itself counts as force,
the line does not bend towards the peak, and slip across is not seen.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.contact.contact_model import slip_of_force, tyre_parameters
from pcw_description.differential_kinematics import forward_kinematics_kernel, wheel_jacobian_kernel
from pcw_description.robot_description import GRAVITY, STEER, FloatArray, RobotDescription

from .errors import require, require_dt
from .slip_estimate import (
    JointMeasurement,
    SlipEstimate,
    WheelEstimate,
    WheelMeasurement,
    WheelModel,
    ratio_of,
    ratios_and_angles,
)


@dataclasses.dataclass(frozen=True)
class MotorCurrentParameters:
    """How the line is drawn and when a wheel is taken to slip for good.

    Attributes:
        fitted_use: part of the peak friction at which the line meets the friction curve [1].
        slipping_use: part of the peak friction above which the motor's torque means that all wheels slip [1].
    """

    fitted_use: float = 0.5
    slipping_use: float = 0.9

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            EstimationError: names the field, its value and what is allowed.
        """
        require("fitted_use", self.fitted_use, above=0.0, maximum=0.9)
        require("slipping_use", self.slipping_use, above=0.0, maximum=2.0)

    def line(self, tyre: FloatArray, peak_friction: float, normal_force: float, radius: float) -> float:
        """Return c [1/(N m)]."""
        force = self.fitted_use * peak_friction * normal_force
        slip, _ = slip_of_force(tyre, force, 0.0, normal_force)
        return float(slip) / (force * radius)


class WheelCurrentDetector:
    """The detector of one wheel; it keeps no state.

    Args:
        wheel: the wheel.
        parameters: of the line.
    """

    def __init__(self, wheel: WheelModel, parameters: MotorCurrentParameters | None = None) -> None:
        self.wheel, self.parameters = wheel, parameters or MotorCurrentParameters()
        self._slope = self.parameters.line(wheel.tyre(), wheel.contact.mu_p, wheel.normal_force, wheel.radius)

    def initial_state(self, velocity: float = 0.0) -> None:
        """Return the state, which is none."""

    def step(self, state: None, measurement: WheelMeasurement, dt: float) -> tuple[None, WheelEstimate]:
        """Take one reading; as `SlidingModeObserver.step`.

        Raises:
            EstimationError: speed or torque is not finite, or dt is not positive.
        """
        require_dt(dt)
        require("roll_rate", measurement.roll_rate)
        require("drive_torque", measurement.drive_torque)
        rolling = self.wheel.radius * measurement.roll_rate
        force = measurement.drive_torque / self.wheel.radius
        velocity = rolling * (1.0 - self._slope * measurement.drive_torque * math.copysign(1.0, rolling))
        valid = abs(force) <= self.parameters.slipping_use * self.wheel.contact.mu_p * self.wheel.normal_force
        estimate = WheelEstimate(
            velocity, measurement.roll_rate, ratio_of(rolling, velocity), force, math.inf, valid, valid, valid
        )
        return None, estimate

    def run(
        self, roll_angle: FloatArray, roll_rate: FloatArray, drive_torque: FloatArray, dt: float, velocity: float = 0.0
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Take a whole record (T,); returns velocity, force and bound, as `SlidingModeObserver.run`."""
        rolling = self.wheel.radius * roll_rate
        found = rolling * (1.0 - self._slope * drive_torque * np.copysign(1.0, rolling))
        return found, drive_torque / self.wheel.radius, np.full(len(found), math.inf)


class RobotCurrentDetector:
    """The detector of a whole robot; the twist fits all corrected wheel speeds (3.26).

    Args:
        robot: the robot.
        parameters: of the line.
        gravity: [m/s^2].
    """

    def __init__(
        self, robot: RobotDescription, parameters: MotorCurrentParameters | None = None, gravity: float = GRAVITY
    ) -> None:
        self.robot, self.parameters = robot, parameters or MotorCurrentParameters()
        load = robot.total_mass * gravity / robot.n
        self._slope = np.array(
            [
                self.parameters.line(tyre_parameters(tyre), tyre.mu_p, load, float(radius))
                for tyre, radius in zip(robot.tyres, robot.wheel_radius, strict=True)
            ]
        )
        self._peak = np.array([tyre.mu_p * load for tyre in robot.tyres])

    def initial_state(self, twist: FloatArray | None = None) -> None:
        """Return the state, which is none."""

    def step(self, state: None, measurement: JointMeasurement, dt: float) -> tuple[None, SlipEstimate]:
        """Take one reading; as `RobotSlidingModeObserver.step`.

        Raises:
            EstimationError: a reading is not finite, or dt is not positive.
        """
        require_dt(dt)
        robot = self.robot
        measurement.check(robot.n)
        steer_angle = np.ascontiguousarray(measurement.position[:, STEER])
        torque = measurement.effort[:, 0]
        rate = measurement.velocity.copy()
        rate[:, 0] *= 1.0 - self._slope * torque * np.copysign(1.0, rate[:, 0])
        twist, _, _ = forward_kinematics_kernel(robot.steer_axis, robot.caster_offset, robot.wheel_radius, steer_angle, rate)
        velocity = (wheel_jacobian_kernel(robot.steer_axis, robot.caster_offset, steer_angle) @ twist).reshape(-1, 2)
        offset, measured = robot.caster_offset, measurement.velocity
        sensed = np.stack(
            [robot.wheel_radius * measured[:, 0] + offset[:, 1] * measured[:, 1], -offset[:, 0] * measured[:, 1]], axis=1
        )
        force = np.stack([torque / robot.wheel_radius, np.zeros(robot.n)], axis=1)
        fine = np.abs(force[:, 0]) <= self.parameters.slipping_use * self._peak
        nothing = np.zeros(robot.n, dtype=bool)
        along = np.stack([fine, nothing], axis=1)  # of slip and force across it says nothing
        estimate = SlipEstimate(
            twist, velocity, sensed - velocity, ratios_and_angles(sensed, velocity), force, math.inf,
            np.repeat((nothing | bool(fine.all()))[:, None], 2, axis=1), along, along.copy(),
        )  # fmt: skip
        return None, estimate

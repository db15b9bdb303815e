"""What a robot's channels would be with an effect at work that is not a torque on a joint.

The effect's own function is called where it acts: on the description, on what was read, on what gravity and other forces
do. The difference to the channels without it, per unit of a parameter, is the effect's column; nothing is derived by hand.

Effects that act between command and motor, in a gear, or at a place of the ground do not show in these channels, or not by a
derivative, and are left to others.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from pcw_description.effects.effect import Effect
from pcw_description.effects.kinds import (
    COM_X,
    COM_Y,
    COM_Z,
    FORCE_INPUTS,
    FORCE_TIME,
    TWIST_X,
    TWIST_YAW,
    ChassisForceEffect,
    ClockEffect,
    DescriptionEffect,
    EncoderEffect,
    GravityEffect,
    ImuEffect,
)
from pcw_description.effects.registry import get
from pcw_description.robot_description import AXIS_NAMES, GRAVITY, STEER, RobotDescription

from .regression_problem import FloatArray
from .robot_motion import RobotMotion
from .rolling_model import ModelNumbers, channel_sides, twists
from .signal_filter import derivative

Sides = tuple[FloatArray, FloatArray]
SEEN_KINDS = (DescriptionEffect, EncoderEffect, ImuEffect, ClockEffect, GravityEffect, ChassisForceEffect)


def with_yaw(motions: Sequence[RobotMotion], numbers: ModelNumbers) -> list[RobotMotion]:
    """Return the motions with a yaw everywhere: where none was tracked, from the wheels, zero where a recording begins.

    Over a gap the yaw rate goes in a line from its last value to its next.
    """
    found: list[RobotMotion] = []
    last_rate = 0.0
    for motion in motions:
        if np.isfinite(motion.yaw).all():
            found.append(motion)
            continue
        angle = np.ascontiguousarray(motion.position[:, :, STEER])
        rate = twists(numbers.steer_axis, numbers.caster_offset, numbers.radius, angle, motion.velocity)[0][:, 2]
        start = 0.0
        if found and found[-1].recording == motion.recording:
            start = found[-1].yaw[-1] + 0.5 * (last_rate + rate[0]) * (motion.time[0] - found[-1].time[-1])
        steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(motion.time)
        found.append(dataclasses.replace(motion, yaw=start + np.concatenate([[0.0], np.cumsum(steps)])))
        last_rate = rate[-1]
    return found


def with_true_angles(
    robot: RobotDescription,
    motion: RobotMotion,
    effect: EncoderEffect,
    target: Sequence[str],
    values: Mapping[str, float],
    axis: str | None,
) -> RobotMotion:
    """Return the motion with the error of its readings taken back, to first order."""
    position, velocity = motion.position.copy(), motion.velocity.copy()
    column = AXIS_NAMES.index(axis or effect.axis)
    for name in target:
        i = robot.caster_index(name)
        seen = motion.position[:, i, column], motion.velocity[:, i, column]
        again = effect.measure(*seen, values)
        position[:, i, column] -= again[0] - seen[0]
        velocity[:, i, column] -= again[1] - seen[1]
    return dataclasses.replace(motion, position=position, velocity=velocity)


def without_reading_errors(robot: RobotDescription, motion: RobotMotion) -> RobotMotion:
    """Return the motion without the errors of readings that the robot's `physics` hold."""
    for instance in robot.physics:
        effect = get(instance.name)
        if isinstance(effect, EncoderEffect):
            motion = with_true_angles(robot, motion, effect, instance.target, instance.parameters, instance.axis)
    return motion


@dataclasses.dataclass(frozen=True)
class ChannelModel:
    """The channels of one robot as it is described, the effects of its `physics` at work but for torques on joints.

    Attributes:
        robot: with the numbers that its effects change already changed.
        numbers: of that robot.
        balanced: whether there are channels of forces; has_imu: whether there are those of an IMU.
    """

    robot: RobotDescription
    numbers: ModelNumbers
    balanced: bool
    has_imu: bool

    def sides(
        self, motion: RobotMotion, numbers: ModelNumbers | None = None, added_torque: FloatArray | None = None
    ) -> Sides:
        """Measured and predicted side of every channel along a motion without errors of reading, (T, C) each."""
        sides = channel_sides(motion, numbers or self.numbers, self.balanced, self.has_imu, added_torque)
        for instance in self.robot.physics:
            self._apply(motion, get(instance.name), instance.parameters, *sides)
        return sides

    def sides_with(
        self, motion: RobotMotion, plain: Sides, effect: Effect, target: Sequence[str], values: Mapping[str, float]
    ) -> Sides:
        """The same with an effect at work.

        Args:
            motion: the motion.
            plain: the sides without the effect.
            effect: one of `SEEN_KINDS`.
            target: where it is.
            values: all its parameters.
        """
        if isinstance(effect, DescriptionEffect):
            return self.sides(motion, ModelNumbers.of(effect.apply(self.robot, target, values)))
        if isinstance(effect, EncoderEffect):
            return self.sides(with_true_angles(self.robot, motion, effect, target, values, None))
        sides = plain[0].copy(), plain[1].copy()
        self._apply(motion, effect, values, *sides)
        return sides

    def _apply(
        self, motion: RobotMotion, effect: Effect, values: Mapping[str, float], measured: FloatArray, predicted: FloatArray
    ) -> None:
        """Change both sides as an effect on forces, gravity, IMU or its clock does; other kinds change nothing here."""
        if isinstance(effect, ChassisForceEffect) and self.balanced:
            wrench = effect.contribution(self._at(motion), values)
            measured[:, :3] += wrench[:, [0, 1, 5]]
        elif isinstance(effect, GravityEffect):
            self.lean(motion, effect.gravity(values), measured, predicted)
        elif isinstance(effect, ImuEffect) and self.has_imu:
            sensed = predicted[:, -3:]
            zero = np.zeros(len(sensed))
            rate, acceleration = effect.measure(
                np.column_stack([zero, zero, sensed[:, 0]]), np.column_stack([sensed[:, 1:], zero + GRAVITY]), values
            )
            predicted[:, -3:] = np.column_stack([rate[:, 2], acceleration[:, :2]])
        elif isinstance(effect, ClockEffect) and self.has_imu:
            # What bears the stamp t was sensed the offset earlier: what was sensed at t bears t + offset.
            measured[:, -3:] += effect.offset("imu/data", values) * derivative(motion.imu, motion.rate)

    def _twist(self, motion: RobotMotion) -> FloatArray:
        numbers = self.numbers
        angle = np.ascontiguousarray(motion.position[:, :, STEER])
        twist, _ = twists(numbers.steer_axis, numbers.caster_offset, numbers.radius, angle, motion.velocity)
        return twist

    def _mass_and_centre(self) -> tuple[float, FloatArray]:
        """Mass of the whole robot [kg] and its centre (3,) [m], the casters' modules at their axes."""
        chassis, modules = self.robot.chassis, self.numbers.modules
        mass = chassis.mass + float(modules[:, 0].sum())
        moment = chassis.mass * np.array(chassis.com)
        moment[:2] += modules[:, 0] @ self.numbers.steer_axis
        moment[2] += float(modules[:, 0] @ self.numbers.radius)
        return mass, moment / mass

    def _at(self, motion: RobotMotion) -> FloatArray:
        at = np.zeros((len(motion.time), FORCE_INPUTS))
        at[:, FORCE_TIME] = motion.time
        at[:, TWIST_X : TWIST_YAW + 1] = self._twist(motion)
        at[:, [COM_X, COM_Y, COM_Z]] = self._mass_and_centre()[1]
        return at

    def _held_by_steering(self, motion: RobotMotion, along: FloatArray, across: FloatArray) -> FloatArray:
        """Wrench (T, 3) of the side forces by which the wheels hold their modules' weights against turning downhill.

        Of the steering's balance, b_x F_y = ... - (m c x g), what gravity g (T,) in base_link adds to F_y.
        """
        wrench = np.zeros((len(motion.time), 3))
        for i, (module, b) in enumerate(zip(self.numbers.modules, self.numbers.caster_offset, strict=True)):
            c, s = np.cos(motion.position[:, i, STEER]), np.sin(motion.position[:, i, STEER])
            lever_x, lever_y = module[1] * c - module[2] * s, module[1] * s + module[2] * c
            side = -module[0] * (lever_x * across - lever_y * along) / b[0]
            place_x = self.numbers.steer_axis[i, 0] + b[0] * c - b[1] * s
            place_y = self.numbers.steer_axis[i, 1] + b[0] * s + b[1] * c
            wrench += np.column_stack([-s * side, c * side, (place_x * c + place_y * s) * side])
        return wrench

    def lean(self, motion: RobotMotion, change: FloatArray, measured: FloatArray, predicted: FloatArray) -> None:
        """Change both sides as gravity does whose unit vector leans by `change` (3,), in the axes of the yaw."""
        pull = GRAVITY * change
        c, s = np.cos(motion.yaw), np.sin(motion.yaw)
        along, across = c * pull[0] + s * pull[1], c * pull[1] - s * pull[0]
        if self.balanced:
            mass, centre = self._mass_and_centre()
            measured[:, 0] += mass * along
            measured[:, 1] += mass * across
            measured[:, 2] += mass * (centre[0] * across - centre[1] * along)
            measured[:, :3] += self._held_by_steering(motion, along, across)
        if self.has_imu:
            predicted[:, -2] -= along
            predicted[:, -1] -= across

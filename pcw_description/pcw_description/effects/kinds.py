"""The places of a robot where an effect can act, one class each; a simulator calls the class's function there.

| kind | where it acts | its function |
|---|---|---|
| `DescriptionEffect` | a number of the robot is another than described | `apply(robot, target, parameters)` |
| `JointTorqueEffect` | torque on a joint, or on the motor before its gear | compiled `torque` |
| `ActuatorEffect` | between the commanded torque and the motor's | compiled `drive` |
| `TransmissionEffect` | between motor and joint, which then move apart | `gear(parameters)` |
| `ContactEffect` | under one wheel: friction, height of the ground, rolling radius | compiled `contact` |
| `ChassisForceEffect` | a force on the chassis | compiled `wrench` |
| `GravityEffect` | the direction of gravity | `gravity(parameters)` |
| `ImuEffect`, `EncoderEffect` | between the truth and a reading | `measure(...)` |
| `ClockEffect` | between the time of a reading and its stamp | `offset(topic, parameters)` |

Compiled kernels other than joint torques have the signature (at, parameters, result), all arrays; the constants below name
their entries. They change `result` in place, adding to what is there (factors multiply), so that effects of one kind add up.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..compiled import array_kernel_along, joint_torque_along
from ..robot_description import RobotDescription
from .effect import Effect, FloatArray

Values = Mapping[str, float]

# ContactEffect, `at`: time [s], wheel centre in the world [m], roll angle [rad], normal force of the step before [N].
CONTACT_TIME, CONTACT_X, CONTACT_Y, ROLL_ANGLE, LOAD = range(5)
CONTACT_INPUTS = 5
# `result`: factor on the friction [1]; change of the rolling radius [m] and its slope over the roll angle [m/rad];
# height of the ground [m] and its gradient in the world [1].
FRICTION, RADIUS_CHANGE, RADIUS_SLOPE, HEIGHT, GRADIENT_X, GRADIENT_Y = range(6)
CONTACT_RESULTS = 6

# ChassisForceEffect, `at`: time [s], pose in the world [m, m, rad], twist [m/s, m/s, rad/s] and the whole robot's centre of
# mass [m] in base_link. `result`: force [N] and moment about base_link's origin [N m], both in base_link, (6,).
FORCE_TIME, POSE_X, POSE_Y, POSE_YAW, TWIST_X, TWIST_Y, TWIST_YAW, COM_X, COM_Y, COM_Z = range(10)
FORCE_INPUTS = 10
FORCE_RESULTS = 6

# ActuatorEffect, `at`: motor speed, joint side [rad/s], step [s]. `result`: the torque on its way through the actuator
# [N m], in and out, and behind it what the effect remembers from step to step, zero at the start.
MOTOR_RATE, STEP = range(2)
ACTUATOR_INPUTS = 2
TORQUE, MEMORY = range(2)


@dataclasses.dataclass(frozen=True)
class DescriptionEffect(Effect):
    """An effect that is a number of the description being another one than stated.

    Attributes:
        apply: function (robot, target, parameters dict) -> the robot as it really is.
    """

    apply: Callable[[RobotDescription, Sequence[str], Values], RobotDescription] = dataclasses.field(
        default=lambda robot, *_: robot, repr=False
    )


@dataclasses.dataclass(frozen=True)
class JointTorqueEffect(Effect):
    """A torque that the effect adds to one joint of each targeted caster.

    Attributes:
        torque: compiled kernel (position [rad], velocity [rad/s], motor_torque [N m], normal_force [N],
            parameters (len(self.parameters),)) -> torque [N m] and minus its slope over velocity [N m s/rad], by which
            plants take friction implicitly; on a linear bench axis m, m/s and N instead.
        motor_side: it acts on the motor, before gears that play, twist or are coupled; position, velocity and motor_torque
            are the motor's own, joint side, and its torque goes to both joints where their gears are coupled.
    """

    torque: Callable[..., tuple[float, float]] = dataclasses.field(default=lambda *_: (0.0, 0.0), repr=False)
    motor_side: bool = False

    def contribution(
        self,
        position: FloatArray,
        velocity: FloatArray,
        motor_torque: FloatArray,
        normal_force: FloatArray,
        parameters: Values,
    ) -> FloatArray:
        """Evaluate the kernel along a recording; all arrays (T,), result (T,) [N m]."""
        q, v, tau, load = (np.ascontiguousarray(a, dtype=float) for a in (position, velocity, motor_torque, normal_force))
        torque: FloatArray = joint_torque_along(self.torque, q, v, tau, load, self.values(parameters))
        return torque

    def regressor(
        self,
        position: FloatArray,
        velocity: FloatArray,
        motor_torque: FloatArray,
        normal_force: FloatArray,
        parameters: Values,
    ) -> dict[str, FloatArray]:
        """Return d contribution / d parameter for every linear parameter, each (T,)."""

        def contribution(values: Values) -> FloatArray:
            return self.contribution(position, velocity, motor_torque, normal_force, values)

        return _unit_columns(self, contribution, parameters)


@dataclasses.dataclass(frozen=True)
class ActuatorEffect(Effect):
    """What becomes of a torque command before it is the motor's torque.

    Attributes:
        drive: compiled kernel; see `MOTOR_RATE` and `TORQUE` above.
        memory: function (parameter values, step [s]) -> how many numbers it remembers.
        stage: effects of one joint act in the order of their stages: 0 on the way to the drive, 1 in its current loop,
            2 at the motor's terminals.
    """

    drive: Callable[..., None] = dataclasses.field(default=lambda *_: None, repr=False)
    memory: Callable[[Values, float], int] = dataclasses.field(default=lambda *_: 0, repr=False)
    stage: int = 1


@dataclasses.dataclass(frozen=True)
class Gear:
    """A gear that is not rigid: engaged, it is a spring and damper; within its play it transmits nothing.

    Attributes:
        stiffness: joint side [N m/rad].
        damping: joint side [N m s/rad].
        play: joint angle through which the motor turns without moving the joint [rad].
    """

    stiffness: float
    damping: float
    play: float


@dataclasses.dataclass(frozen=True)
class TransmissionEffect(Effect):
    """A gear between motor and joint; several on one joint are in series.

    Attributes:
        gear: function (parameter values) -> Gear.
    """

    gear: Callable[[Values], Gear] = dataclasses.field(default=lambda _: Gear(1e9, 0.0, 0.0), repr=False)


@dataclasses.dataclass(frozen=True)
class ContactEffect(Effect):
    """What a wheel finds under it, or is itself at its rolling circumference.

    Attributes:
        contact: compiled kernel; see `CONTACT_TIME` and `FRICTION` above.
    """

    contact: Callable[..., None] = dataclasses.field(default=lambda *_: None, repr=False)

    def is_at(self, places: FloatArray, parameters: Values) -> np.ndarray:
        """Whether a wheel at places (..., 2) [m] of the world finds it there: (...) of bool."""
        flat = places.reshape(-1, 2)
        at, found = np.zeros((len(flat), CONTACT_INPUTS)), np.zeros((len(flat), CONTACT_RESULTS))
        at[:, CONTACT_X : CONTACT_Y + 1] = flat
        found[:, FRICTION] = 1.0
        array_kernel_along(self.contact, at, self.values(parameters), found)
        found[:, FRICTION] -= 1.0
        there: np.ndarray = np.any(found != 0.0, axis=1).reshape(places.shape[:-1])
        return there


@dataclasses.dataclass(frozen=True)
class ChassisForceEffect(Effect):
    """A force on the chassis that no wheel makes.

    Attributes:
        wrench: compiled kernel; see `FORCE_TIME` above.
    """

    wrench: Callable[..., None] = dataclasses.field(default=lambda *_: None, repr=False)

    def contribution(self, at: FloatArray, parameters: Values) -> FloatArray:
        """Evaluate the kernel along rows `at` (T, FORCE_INPUTS); result (T, FORCE_RESULTS) [N, N m]."""
        total = np.zeros((len(at), FORCE_RESULTS))
        array_kernel_along(self.wrench, np.ascontiguousarray(at, dtype=float), self.values(parameters), total)
        return total

    def regressor(self, at: FloatArray, parameters: Values) -> dict[str, FloatArray]:
        """Return d contribution / d parameter for every linear parameter, each (T, FORCE_RESULTS)."""
        return _unit_columns(self, lambda values: self.contribution(at, values), parameters)


@dataclasses.dataclass(frozen=True)
class GravityEffect(Effect):
    """Gravity not along the normal of the floor.

    Attributes:
        gravity: function (parameter values) -> change of the unit vector of gravity (3,), world axes, whose z is the normal
            of the floor; on a level floor gravity is (0, 0, -1).
    """

    gravity: Callable[[Values], FloatArray] = dataclasses.field(default=lambda _: np.zeros(3), repr=False)


@dataclasses.dataclass(frozen=True)
class ImuEffect(Effect):
    """An error of the IMU.

    Attributes:
        measure: function (angular_velocity (..., 3) [rad/s], linear_acceleration (..., 3) [m/s^2], parameter values) -> both
            as the IMU reports them.
    """

    measure: Callable[[FloatArray, FloatArray, Values], tuple[FloatArray, FloatArray]] = dataclasses.field(
        default=lambda rate, acceleration, _: (rate, acceleration), repr=False
    )


@dataclasses.dataclass(frozen=True)
class EncoderEffect(Effect):
    """An error of the angle that one joint of each targeted caster reports.

    Attributes:
        measure: function (position [rad], velocity [rad/s], parameter values) -> both as they are reported, element by
            element of arrays of one shape.
    """

    measure: Callable[[FloatArray, FloatArray, Values], tuple[FloatArray, FloatArray]] = dataclasses.field(
        default=lambda position, velocity, _: (position, velocity), repr=False
    )


@dataclasses.dataclass(frozen=True)
class ClockEffect(Effect):
    """Stamps of another clock than that of joint_states.

    Attributes:
        offset: function (relative topic name, parameter values) -> what is added to the topic's stamps [s].
    """

    offset: Callable[[str, Values], float] = dataclasses.field(default=lambda *_: 0.0, repr=False)


def _unit_columns(
    effect: Effect, contribution: Callable[[Values], FloatArray], parameters: Values
) -> dict[str, FloatArray]:
    """Return the contribution's derivative in each linear parameter.

    Exact because the contribution is linear in them: each column is the kernel at a unit parameter, the other linear
    ones at zero, the shaping ones as given.
    """
    zero: dict[str, Any] = {p.name: 0.0 for p in effect.linear_parameters}
    return {name: contribution({**parameters, **zero, name: 1.0}) for name in zero}

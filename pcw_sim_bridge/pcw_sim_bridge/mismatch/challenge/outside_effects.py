"""Physics that is in no library: what the analyser must call unknown, and not by a wrong name.

Those of the vocabulary's own kinds are written as a third party would write them, and are known only while the simulator
runs (`also_known`). A `CrossJointLaw` is of no kind at all: its torque depends on other joints or on time, and `LawPlant` adds
it to what the motors give, behind their torque sensors.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from pcw_description.compiled import compiled_array_kernel, compiled_joint_torque
from pcw_description.effects.effect import Effect, EffectParameter
from pcw_description.effects.kinds import (
    FORCE_TIME,
    POSE_X,
    POSE_YAW,
    TWIST_X,
    TWIST_Y,
    ChassisForceEffect,
    JointTorqueEffect,
)
from pcw_description.robot_description import DRIVE, STEER, FloatArray, RobotDescription

from ...plants.plant import Plant, PlantState

SMOOTHING_SPEED = 0.1  # [rad/s]; over which friction reverses


def _number(name: str, unit: str, help_text: str, upper: float = 1e4) -> EffectParameter:
    return EffectParameter(name, unit, help_text, -upper, upper, 1.0)


# -- effects of the vocabulary's own kinds ------------------------------------------------------------------------


@compiled_joint_torque
def friction_by_heading(position, velocity, motor_torque, normal_force, parameters):  # type: ignore[no-untyped-def]
    """Return friction that comes and goes twice per turn of the steering: -size (1 + cos(2 q)) sgn(v)."""
    size = parameters[0] * (1.0 + math.cos(2.0 * position - parameters[1]))
    sign = math.tanh(velocity / 0.1)
    return -size * sign, size * (1.0 - sign * sign) / 0.1


@compiled_joint_torque
def uneven_gain(position, velocity, motor_torque, normal_force, parameters):  # type: ignore[no-untyped-def]
    """Return size * |torque|: a motor that is stronger one way than the other."""
    return parameters[0] * abs(motor_torque), 0.0


@compiled_joint_torque
def hard_spot(position, velocity, motor_torque, normal_force, parameters):  # type: ignore[no-untyped-def]
    """Return friction at one place of the turn only: -size exp(-(angle from it / width)^2 / 2) sgn(v)."""
    turns = (position - parameters[1]) / (2.0 * math.pi)
    angle = 2.0 * math.pi * (turns - math.floor(turns + 0.5)) / 0.3
    size = parameters[0] * math.exp(-0.5 * angle * angle)
    sign = math.tanh(velocity / 0.1)
    return -size * sign, size * (1.0 - sign * sign) / 0.1


@compiled_joint_torque
def quadratic_drag(position, velocity, motor_torque, normal_force, parameters):  # type: ignore[no-untyped-def]
    """Return -size v |v|: churning oil."""
    return -parameters[0] * velocity * abs(velocity), 2.0 * parameters[0] * abs(velocity)


@compiled_array_kernel
def pull_by_place(at, parameters, result):  # type: ignore[no-untyped-def]
    """Add a force along the world's x that waves along the world's x and y."""
    x, y, yaw = at[POSE_X], at[POSE_X + 1], at[POSE_YAW]
    force = parameters[0] * math.sin(2.0 * math.pi * x / parameters[1]) * math.cos(2.0 * math.pi * y / parameters[1])
    result[0] += force * math.cos(yaw)
    result[1] -= force * math.sin(yaw)


@compiled_array_kernel
def growing_drag(at, parameters, result):  # type: ignore[no-untyped-def]
    """Add a force against the motion that grows from nothing with the time."""
    grown = parameters[0] * (1.0 - math.exp(-at[FORCE_TIME] / parameters[1]))
    result[0] -= grown * at[TWIST_X]
    result[1] -= grown * at[TWIST_Y]


@compiled_array_kernel
def side_force_in_curves(at, parameters, result):  # type: ignore[no-untyped-def]
    """Add a moment by speed forwards times speed sideways, as a keel makes it."""
    result[5] += parameters[0] * at[TWIST_X] * at[TWIST_Y]


# -- laws across joints and time ----------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class CrossJointLaw(Effect):
    """A torque on joints that depends on other joints, or on time.

    Attributes:
        law: (state, target casters (k,), parameters) -> torques to add (n, 2) [N m].
    """

    law: Callable[[PlantState, Sequence[int], Mapping[str, float]], FloatArray] = dataclasses.field(
        default=lambda state, *_: np.zeros_like(state.motor_torque), repr=False
    )


def _fading(state: PlantState, casters: Sequence[int], parameters: Mapping[str, float]) -> FloatArray:
    added = np.zeros_like(state.motor_torque)
    lost = parameters["size"] * (1.0 - math.exp(-state.time / parameters["time_constant"]))
    added[casters, DRIVE] = -lost * state.motor_torque[casters, DRIVE]
    return added


def _coupled(state: PlantState, casters: Sequence[int], parameters: Mapping[str, float]) -> FloatArray:
    added = np.zeros_like(state.motor_torque)
    sign = np.tanh(state.joint_velocity[casters, DRIVE] / SMOOTHING_SPEED)
    added[casters, DRIVE] = -parameters["size"] * np.tanh(np.abs(state.joint_velocity[casters, STEER])) * sign
    return added


class LawPlant:
    """A plant whose joints feel a law besides; see `Plant`. Its motors do not know of it."""

    def __init__(self, plant: Plant, law: CrossJointLaw, target: Sequence[str], parameters: Mapping[str, float]) -> None:
        self._plant, self._law, self._parameters = plant, law, parameters
        self.robot: RobotDescription = plant.robot
        self.dt = plant.dt
        self._casters = [plant.robot.caster_index(name) for name in target]
        self._added = np.zeros((plant.robot.n, 2))

    def reset(self, pose: FloatArray | None = None, steer_angle: FloatArray | None = None) -> None:
        """See `Plant`; nothing is added yet."""
        self._plant.reset(pose, steer_angle)
        self._added = np.zeros_like(self._added)

    def set_motion(self, twist: FloatArray, joint_position: FloatArray, joint_velocity: FloatArray) -> None:
        """See `Plant`."""
        self._plant.set_motion(twist, joint_position, joint_velocity)

    def step(self, motor_torque: FloatArray, steps: int = 1) -> None:
        """Advance step by step, the law evaluated at each."""
        for _ in range(steps):
            self._added = self._law.law(self.state(), self._casters, self._parameters)
            self._plant.step(motor_torque + self._added)

    def state(self) -> PlantState:
        """Return the truth, the motors' torques without what the law adds."""
        state = self._plant.state()
        return dataclasses.replace(state, motor_torque=state.motor_torque - self._added)

    def close(self) -> None:
        """Free what the plant holds."""
        self._plant.close()


# -- the list -----------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class OutsideEffect:
    """One of them, and what a good report says of it.

    Attributes:
        effect: the effect.
        variables: what it depends on most, as the analyser names its variables before the slash; any of them leads right.
    """

    effect: Effect
    variables: tuple[str, ...]


def _made(kind: Any, name: str, axis: str, summary: str, parameters: tuple[EffectParameter, ...], **function: Any) -> Effect:
    made: Effect = kind(
        name=name, target_kind="chassis" if axis == "chassis" else "caster", axis=axis, summary=summary, sentence=summary,
        parameters=parameters, sensors=("joint_states",), **function,
    )
    return made


def _all() -> dict[str, OutsideEffect]:
    phase = _number("phase", "rad", "where it is", 7.0)
    force = _number("size", "N", "largest force", 1e5)
    found = [
        OutsideEffect(
            _made(JointTorqueEffect, "heading_friction", "steer", "Friction of the steering that depends on its angle.",
                  (_number("size", "N m", "mean friction"), phase), torque=friction_by_heading),
            ("steer_angle", "steer_velocity"),
        ),
        OutsideEffect(
            _made(JointTorqueEffect, "uneven_gain", "drive", "A motor stronger one way than the other.",
                  (_number("size", "1", "part of the torque", 0.9),), torque=uneven_gain),
            ("drive_torque",),
        ),
        OutsideEffect(
            _made(JointTorqueEffect, "hard_spot", "drive", "Friction at one place of the turn of a wheel.",
                  (_number("size", "N m", "largest friction"), phase), torque=hard_spot),
            ("drive_angle",),
        ),
        OutsideEffect(
            _made(JointTorqueEffect, "quadratic_drag", "steer", "Friction of the steering that grows with its speed squared.",
                  (_number("size", "N m s^2/rad^2", "friction per speed squared"),), torque=quadratic_drag),
            ("steer_velocity",),
        ),
        OutsideEffect(
            _made(ChassisForceEffect, "place_pull", "chassis", "A force that depends on the place.",
                  (force, _number("wavelength", "m", "from crest to crest")), wrench=pull_by_place),
            ("place", "pose", "x", "y", "place_x", "place_y"),
        ),
        OutsideEffect(
            _made(ChassisForceEffect, "growing_drag", "chassis", "A drag that grows with time.",
                  (_number("size", "N s/m", "in the end", 1e5), _number("time_constant", "s", "of its growth", 1e3)),
                  wrench=growing_drag),
            ("time", "v_x", "v_y"),
        ),
        OutsideEffect(
            _made(ChassisForceEffect, "keel", "chassis", "A moment of speed forwards times speed sideways.",
                  (_number("size", "N s^2/m", "moment per both speeds", 1e5),), wrench=side_force_in_curves),
            ("v_x", "v_y"),
        ),
        OutsideEffect(
            _made(CrossJointLaw, "fading_torque", "drive", "A drive that loses torque with time, as it gets warm.",
                  (_number("size", "1", "part that is lost in the end", 0.9),
                   _number("time_constant", "s", "of the loss", 1e3)), law=_fading),
            ("time",),
        ),
        OutsideEffect(
            _made(CrossJointLaw, "coupled_friction", "drive", "Friction of the drive while the steering turns.",
                  (_number("size", "N m", "largest friction"),), law=_coupled),
            ("steer_velocity", "drive_velocity"),
        ),
    ]
    return {entry.effect.name: entry for entry in found}


OUTSIDE_EFFECTS: Mapping[str, OutsideEffect] = _all()

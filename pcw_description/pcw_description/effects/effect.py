"""What a physical effect is: parameters, contribution, regressor, and how to say it.

An effect is written once. A simulator calls its contribution, the analyser its regressor, the report its statement.
A third party adds one by a module with a module-level `EFFECT`, in this folder or behind the entry-point group
`pcw_description.effects`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import joint_torque_along, joint_torque_list
from ..errors import DescriptionError, nearest_name
from ..robot_description import RobotDescription

FloatArray = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class EffectParameter:
    """One number of an effect.

    Attributes:
        typical: a size at which the effect matters on a robot of 50 to 100 kg; the analyser's prior scale.
        default: used when the description leaves the parameter out; None if it must be given.
        linear: the contribution is proportional to this parameter (all linear parameters together are additive).
    """

    name: str
    unit: str
    help: str
    lower: float
    upper: float
    typical: float
    default: float | None = None
    linear: bool = False


@dataclasses.dataclass(frozen=True)
class Effect:
    """Base of all effects.

    Attributes:
        name: name in the vocabulary (INTERFACES section 5), also the name of the file.
        target_kind: "caster", "chassis", "imu" or "clock".
        axis: what the report calls the place: "drive", "steer", "chassis", "imu" or "clock".
        summary: one sentence on the physics.
        sentence: the statement with `{target}` and parameter names to be filled in.
        sensors: topics that see the effect.
        look_alikes: names of effects that it is easily mistaken for.
        separating_experiment: what tells it from its look-alikes.
        log_prior: how much rarer than the common effects it is on real robots, as a natural logarithm; decides where a
            recording does not.
    """

    name: str
    target_kind: str
    axis: str
    summary: str
    sentence: str
    parameters: tuple[EffectParameter, ...]
    sensors: tuple[str, ...]
    look_alikes: tuple[str, ...] = ()
    separating_experiment: str = ""
    log_prior: float = 0.0

    def parameter(self, name: str) -> EffectParameter:
        """Return a parameter by its name."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        near = nearest_name(name, [parameter.name for parameter in self.parameters])
        raise DescriptionError(f"effect {self.name}", name, f"unknown parameter; {near}")

    @property
    def linear_parameters(self) -> tuple[EffectParameter, ...]:
        """The parameters that the contribution is proportional to."""
        return tuple(parameter for parameter in self.parameters if parameter.linear)

    @property
    def nonlinear_parameters(self) -> tuple[EffectParameter, ...]:
        """The parameters that shape the contribution."""
        return tuple(parameter for parameter in self.parameters if not parameter.linear)

    def values(self, parameters: Mapping[str, float]) -> FloatArray:
        """Return the values in the order of the declaration, defaults filled in, shape (len(parameters),)."""
        return np.array([float(parameters.get(p.name, p.default)) for p in self.parameters])  # type: ignore[arg-type]

    def check(self, parameters: Mapping[str, Any], where: str) -> dict[str, float]:
        """Return the parameters with defaults, or raise a DescriptionError that names what is wrong."""
        for name in parameters:
            if name not in {parameter.name for parameter in self.parameters}:
                names = [parameter.name for parameter in self.parameters]
                raise DescriptionError(f"{where}.{name}", parameters[name], f"unknown parameter; {nearest_name(name, names)}")
        checked = {}
        for parameter in self.parameters:
            value = parameters.get(parameter.name, parameter.default)
            unit = "" if parameter.unit == "1" else f" {parameter.unit}"
            allowed = f"allowed: {parameter.lower:g} to {parameter.upper:g}{unit} ({parameter.help})"
            if value is None:
                raise DescriptionError(f"{where}.{parameter.name}", None, allowed)
            is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not (is_number and parameter.lower <= value <= parameter.upper):  # NaN fails the comparison as well
                raise DescriptionError(f"{where}.{parameter.name}", value, allowed)
            checked[parameter.name] = float(value)
        return checked

    def statement(self, target: Sequence[str], parameters: Mapping[str, float]) -> str:
        """Return one plain sentence that states the effect with its numbers."""
        filled = {parameter.name: parameter.default for parameter in self.parameters} | dict(parameters)
        return self.sentence.format(target=" and ".join(target), **filled)


@dataclasses.dataclass(frozen=True)
class JointTorqueEffect(Effect):
    """A torque that the effect adds to one joint of each targeted caster.

    Attributes:
        torque: compiled kernel (position [rad], velocity [rad/s], motor_torque [N m], normal_force [N],
            parameters (len(self.parameters),)) -> torque [N m]; on a linear bench axis m, m/s and N instead.
    """

    torque: Callable[..., float] = dataclasses.field(default=lambda *_: 0.0, repr=False)

    def contribution(
        self,
        position: FloatArray,
        velocity: FloatArray,
        motor_torque: FloatArray,
        normal_force: FloatArray,
        parameters: Mapping[str, float],
    ) -> FloatArray:
        """Evaluate the kernel along a recording; all arrays (T,), result (T,) [N m]."""
        q, v, tau, load = (np.ascontiguousarray(a, dtype=float) for a in (position, velocity, motor_torque, normal_force))
        torque: FloatArray = joint_torque_along(joint_torque_list([self.torque]), q, v, tau, load, self.values(parameters))
        return torque

    def regressor(
        self,
        position: FloatArray,
        velocity: FloatArray,
        motor_torque: FloatArray,
        normal_force: FloatArray,
        parameters: Mapping[str, float],
    ) -> dict[str, FloatArray]:
        """Return d contribution / d parameter for every linear parameter, each (T,).

        Exact because the contribution is linear in them: each column is the kernel at a unit parameter, the other
        linear ones at zero, the shaping ones as given.
        """
        columns = {}
        for parameter in self.linear_parameters:
            unit = {other.name: 0.0 for other in self.linear_parameters} | {parameter.name: 1.0}
            columns[parameter.name] = self.contribution(
                position, velocity, motor_torque, normal_force, {**parameters, **unit}
            )
        return columns


@dataclasses.dataclass(frozen=True)
class DescriptionEffect(Effect):
    """An effect that is a number of the description being another one than stated.

    Attributes:
        apply: function (robot, target, parameters dict) -> the robot as it really is.
    """

    apply: Callable[[RobotDescription, Sequence[str], Mapping[str, float]], RobotDescription] = dataclasses.field(
        default=lambda robot, *_: robot, repr=False
    )

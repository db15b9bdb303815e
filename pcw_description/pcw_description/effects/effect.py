"""What a physical effect is: parameters, contribution, regressor, and how to say it.

An effect is written once. A simulator calls its contribution, the analyser its regressor, the report its statement.
`kinds` has a class for every place of a robot where one can act. A third party adds one by a module with a module-level
`EFFECT`, in this folder or behind the entry-point group `pcw_description.effects`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import DescriptionError, nearest_name

FloatArray = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class EffectParameter:
    """One number of an effect.

    Attributes:
        typical: a size at which the effect matters on a robot of 50 to 100 kg; the analyser's prior scale.
        default: used when the description leaves the parameter out; None if it must be given.
        linear: the contribution is proportional to this parameter (all linear parameters together are additive).
        near_linear: it is so near zero, where the effect vanishes with it; its derivative there tells how the effect shows.
        squared: its square is so.
        reciprocal: the inverse of its distance from its pole is so; with a pole at zero, its inverse: the effect vanishes as
            the parameter grows.
        pole: of a reciprocal one: -1 for the relative error of what a denominator holds.
        neutral: where the effect vanishes, if not at zero or without bound: a number, or where in the description it
            stands, as "contact.relaxation_length".
        clause: what the effect's sentence goes on with where the number is not its default; `{name}` stands for it.
    """

    name: str
    unit: str
    help: str
    lower: float
    upper: float
    typical: float
    default: float | None = None
    linear: bool = False
    near_linear: bool = False
    squared: bool = False
    reciprocal: bool = False
    pole: float = 0.0
    neutral: str | float = ""
    clause: str = ""

    @property
    def is_direction(self) -> bool:
        """Whether it is an angle of which all of a turn may be, so that a turn more is the same."""
        return self.unit == "rad" and self.upper - self.lower > math.tau


@dataclasses.dataclass(frozen=True)
class Effect:
    """Base of all effects.

    Attributes:
        name: name in the vocabulary (INTERFACES section 5), also the name of the file.
        target_kind: "caster", "chassis", "imu" or "clock".
        axis: what the report calls the place: "drive", "steer", "chassis", "imu" or "clock".
        axes: joints that it can stand at instead, by the key `axis` of an entry of `physics`; empty if only at `axis`.
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
    axes: tuple[str, ...] = ()

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
    def searched_parameters(self) -> tuple[EffectParameter, ...]:
        """The parameters whose size, beginning at none, a derivative can find."""
        return tuple(p for p in self.parameters if p.linear or p.near_linear or p.squared or p.reciprocal)

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

    def statement(self, target: Sequence[str], parameters: Mapping[str, float], axis: str | None = None) -> str:
        """Return one plain sentence that states the effect with its numbers, at `axis` (default: the effect's own)."""
        filled: dict[str, Any] = {parameter.name: parameter.default for parameter in self.parameters} | dict(parameters)
        joint = {"drive": "drive", "steer": "steering"}.get(axis or self.axis, "")
        clauses = "".join(p.clause for p in self.parameters if filled[p.name] != p.default)
        return (self.sentence.removesuffix(".") + clauses + ".").format(target=" and ".join(target), joint=joint, **filled)

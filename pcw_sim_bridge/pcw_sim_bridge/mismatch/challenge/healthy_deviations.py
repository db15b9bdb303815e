"""How a healthy robot differs from its description: every number that has a tolerance, moved within it.

Numbers of the description are changed in it; what a description does not hold (a steering zero, a gain, a bias, the floor)
is put under `physics`. Deviations are kept by name, so that an answer file can state them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.kinds import DescriptionEffect
from pcw_description.effects.registry import get
from pcw_description.errors import DescriptionError
from pcw_description.robot_description import AXIS_NAMES, Caster, ContactDescription, RobotDescription

Change = Callable[[RobotDescription, float], RobotDescription]
# Healthy robots are no further off than this, in standard deviations; a tyre's stiffness and relaxation cannot vanish.
LARGEST_DEVIATION = 2.5
LARGEST_TYRE_DEVIATION = 1.4
# What somebody tunes stays so near to the description, and so near to the robot, in standard deviations.
TUNED_WITHIN = 2.0
# No tyre gives less than this part of what is described, however it is drawn or tuned.
STIFFEST = 0.2
RELAXATION = "contact.relaxation_length"
TYRE_NUMBERS = ("contact.stiffness", RELAXATION)
# Effects that move healthy numbers: which number each of their parameters moves.
MOVED: Mapping[str, Mapping[str, str]] = {
    "wheel_radius_error": {"error": "wheel_radius/{caster}"},
    "caster_offset_error": {"x": "caster_offset.x/{caster}", "y": "caster_offset.y/{caster}"},
    "steer_zero_offset": {"offset": "steer_zero/{caster}"},
    "torque_constant_error": {"error": "torque_constant/{caster}_{axis}"},
    "payload_offset": {"x": "chassis.com.x", "y": "chassis.com.y", "z": "chassis.com.z"},
    "payload_mass": {"mass": "chassis.mass"},
    "ground_slope": {"angle": "ground.slope.x"},  # whichever its direction: the tolerance is that of y
    "imu_lever_arm": {"x": "imu.position.x", "y": "imu.position.y"},
    "imu_bias": {
        "gyro": "imu.gyro_bias",
        "accelerometer_x": "imu.accelerometer_bias.x",
        "accelerometer_y": "imu.accelerometer_bias.y",
    },
    "imu_scale": {
        "gyro": "imu.gyro_scale",
        "accelerometer_x": "imu.accelerometer_scale.x",
        "accelerometer_y": "imu.accelerometer_scale.y",
    },
    "clock_offset": {"offset": "clock.offset.imu", "tracker_offset": "clock.offset.tracker"},
}
NO_NUMBERS = ("direction",)  # parameters that say which way, not how much


@dataclasses.dataclass(frozen=True)
class HealthyNumber:
    """A number that a healthy robot may differ in.

    Attributes:
        name: as the analyser calls it under `retuned`, where it does.
        deviation: one standard deviation; of `rotors.*` and `contact.*` relative to the number.
        change: (robot, deviation) -> robot.
        described: the number stands in the description, so that somebody may have tuned it there.
    """

    name: str
    deviation: float
    change: Change
    described: bool = True


def healthy_numbers(robot: RobotDescription) -> tuple[HealthyNumber, ...]:
    """Return every number of a robot that has a tolerance."""
    found = [*_shared_numbers(robot)]
    for caster in robot.casters:
        found += _caster_numbers(robot, caster)
    if robot.sensors.imu is not None:
        found += [*_imu_numbers(robot), _clock(robot, "imu", "offset")]
    if robot.sensors.tracker is not None:
        found.append(_clock(robot, "tracker", "tracker_offset"))
    return tuple(found)


def draw_deviations(robot: RobotDescription, rng: np.random.Generator) -> dict[str, float]:
    """Draw how far a healthy robot is off, by the names of `healthy_numbers`."""
    drawn = {}
    for number in healthy_numbers(robot):
        widest = LARGEST_TYRE_DEVIATION if number.name in TYRE_NUMBERS else LARGEST_DEVIATION
        drawn[number.name] = number.deviation * float(np.clip(rng.standard_normal(), -widest, widest))
    return drawn


def with_deviations(robot: RobotDescription, deviations: Mapping[str, float]) -> RobotDescription:
    """Return the robot as it really is.

    Raises:
        DescriptionError: a name that is none of `healthy_numbers`, or a robot that cannot be.
    """
    numbers = {number.name: number for number in healthy_numbers(robot)}
    for name, deviation in deviations.items():
        if name not in numbers:
            raise DescriptionError("deviation", name, f"allowed: {', '.join(numbers)}")
        if deviation != 0.0:
            robot = numbers[name].change(robot, deviation)
    return robot


def tuned_within(robot: RobotDescription, name: str, wanted: float, own: float) -> float:
    """Return how far to tune a number of the description: as wanted, as far as description and robot stay near it.

    Args:
        robot: the description.
        name: one of `healthy_numbers`.
        wanted: deviation that somebody would tune to.
        own: deviation of the robot itself. From the tuned description it is off by TUNED_WITHIN standard deviations at
            most, of the tuned description's own: half of a relaxation length is half of the one that stands there then.
    """
    deviation = _number(robot, name).deviation
    widest = LARGEST_TYRE_DEVIATION if name in TYRE_NUMBERS else TUNED_WITHIN
    wanted = float(np.clip(wanted, -widest * deviation, widest * deviation))
    for part in np.linspace(1.0, 0.0, 101):
        tuned = own + float(part) * (wanted - own)
        off = (1.0 + own) / (1.0 + tuned) - 1.0 if _is_relative(name) else own - tuned
        if abs(off) <= widest * _number(with_deviations(robot, {name: tuned}), name).deviation:
            break
    return tuned


def _number(robot: RobotDescription, name: str) -> HealthyNumber:
    return next(number for number in healthy_numbers(robot) if number.name == name)


def _is_relative(name: str) -> bool:
    return name != RELAXATION and name.startswith(("rotors.", "contact."))


def tolerated_cost(robot: RobotDescription, instance: EffectInstance) -> float:
    """Return what an effect costs as deviations within tolerances, 1/2 sum (value / deviation)^2 [nats].

    Infinite where an effect is more than numbers that a healthy robot may differ in.
    """
    deviations = {number.name: number.deviation for number in healthy_numbers(robot)}
    if instance.name == "payload_mass":  # its place and its mass together move the centre of mass
        return sum(0.5 * (moved / deviations[name]) ** 2 for name, moved in _moved_by_payload(robot, instance).items())
    if instance.name == "tyre_relaxation" and set(instance.target) == set(robot.caster_names):
        longer = instance.parameters["length"] - robot.contact.relaxation_length
        return 0.5 * (longer / deviations[RELAXATION]) ** 2
    cost = 0.0
    for parameter, value in instance.parameters.items():
        if value == 0.0 or parameter in NO_NUMBERS:
            continue
        names = numbers_moved(instance.name, instance.target, parameter, instance.axis)
        if not names:
            return math.inf
        cost += sum(0.5 * (value / deviations[name]) ** 2 for name in names)
    return cost


def _moved_by_payload(robot: RobotDescription, payload: EffectInstance) -> dict[str, float]:
    """How far a payload moves healthy numbers of the chassis, by name."""
    effect = get(payload.name)
    assert isinstance(effect, DescriptionEffect)
    own, loaded = robot.chassis, effect.apply(robot, payload.target, payload.parameters).chassis
    moved = {f"chassis.com.{axis}": there - here for axis, here, there in zip("xyz", own.com, loaded.com, strict=True)}
    return moved | {f"chassis.{name}": getattr(loaded, name) - getattr(own, name) for name in ("mass", "inertia_zz")}


def numbers_moved(effect: str, target: Sequence[str], parameter: str, axis: str | None = None) -> tuple[str, ...]:
    """Return which healthy numbers a parameter of an effect moves; none if it is no such parameter."""
    pattern = MOVED.get(effect, {}).get(parameter)
    if pattern is None:
        return ()
    return tuple(dict.fromkeys(pattern.format(caster=name, axis=axis or get(effect).axis) for name in target))


def effect_instance(
    name: str, target: Sequence[str], parameters: Mapping[str, float], axis: str | None = None
) -> EffectInstance:
    """Return an effect with its defaults filled in.

    Raises:
        DescriptionError: a parameter that is unknown or out of its range.
    """
    return EffectInstance(name, tuple(target), get(name).check(dict(parameters), name), axis)


def _tolerance(robot: RobotDescription, name: str, nominal: float) -> float:
    known = robot.tolerance(name)
    return known.value * abs(nominal) if known.relative else known.value


def _replaced(part: Any, field: str, value: float) -> Any:
    return dataclasses.replace(part, **{field: getattr(part, field) + value})


def _entry(values: tuple[float, ...], index: int, value: float) -> Any:
    """Return the tuple with one of its entries moved."""
    return (*values[:index], values[index] + value, *values[index + 1 :])


def _shared_numbers(robot: RobotDescription) -> list[HealthyNumber]:
    """Numbers of the chassis, of all casters alike, of the ground."""
    chassis, first = robot.chassis, robot.casters[0]

    def of_chassis(field: str) -> Change:
        return lambda r, value: dataclasses.replace(r, chassis=_replaced(r.chassis, field, value))

    def centre(index: int) -> Change:
        return lambda r, value: dataclasses.replace(
            r, chassis=dataclasses.replace(r.chassis, com=_entry(r.chassis.com, index, value))
        )

    def of_all(part: str, field: str, nominal: float) -> Change:
        """Change a number of all casters by the same part of it."""

        def change(r: RobotDescription, value: float) -> RobotDescription:
            def caster_changed(caster: Caster) -> Caster:
                own = getattr(caster, part)
                return dataclasses.replace(caster, **{part: _replaced(own, field, getattr(own, field) * value / nominal)})

            return r.with_casters(r.caster_names, caster_changed)

        return change

    def slope(direction: float) -> Change:
        return lambda r, value: _with_effect(
            r, "ground_slope", ("chassis",), {"angle": abs(value), "direction": direction + (math.pi if value < 0.0 else 0.0)}
        )

    found = [
        HealthyNumber("chassis.mass", _tolerance(robot, "chassis.mass", chassis.mass), of_chassis("mass")),
        HealthyNumber(
            "chassis.inertia_zz", _tolerance(robot, "chassis.inertia_zz", chassis.inertia_zz), of_chassis("inertia_zz")
        ),
        HealthyNumber("chassis.com.x", _tolerance(robot, "chassis.com", 0.0), centre(0)),
        HealthyNumber("chassis.com.y", _tolerance(robot, "chassis.com", 0.0), centre(1)),
        HealthyNumber("chassis.com.z", _tolerance(robot, "chassis.com", 0.0), centre(2)),
        HealthyNumber("contact.mu_p", _tolerance(robot, "contact.mu_p", 1.0), _friction),
        HealthyNumber("contact.stiffness", _tolerance(robot, "contact.stiffness", 1.0), _compliance),
        HealthyNumber(RELAXATION, _tolerance(robot, RELAXATION, robot.contact.relaxation_length), _relaxation),
        HealthyNumber("ground.slope.x", _tolerance(robot, "ground.slope", 0.0), slope(0.0), described=False),
        HealthyNumber("ground.slope.y", _tolerance(robot, "ground.slope", 0.0), slope(0.5 * math.pi), described=False),
    ]
    for name, part, field in (
        ("module.mass", "module", "mass"),
        ("module.inertia_zz", "module", "inertia_zz"),
        ("wheel.inertia_axle", "wheel", "inertia_axle"),
    ):
        nominal = getattr(getattr(first, part), field)
        found.append(HealthyNumber(name, _tolerance(robot, name, nominal), of_all(part, field, nominal)))
    for axis in AXIS_NAMES:
        found.append(HealthyNumber(f"rotors.{axis}", _tolerance(robot, "rotors", 1.0), of_all("rotors", axis, 1.0)))
    return found


def _caster_numbers(robot: RobotDescription, caster: Caster) -> list[HealthyNumber]:
    name = caster.name

    def own(field: str, index: int | None = None) -> Change:
        def change(r: RobotDescription, value: float) -> RobotDescription:
            if index is None:
                return r.with_casters([name], lambda c: _replaced(c, field, value))
            return r.with_casters(
                [name], lambda c: dataclasses.replace(c, **{field: _entry(getattr(c, field), index, value)})
            )

        return change

    def gain(axis: str) -> Change:
        return lambda r, value: _with_effect(r, "torque_constant_error", (name,), {"error": value}, axis)

    def zero(r: RobotDescription, value: float) -> RobotDescription:
        return _with_effect(r, "steer_zero_offset", (name,), {"offset": value})

    found = [
        HealthyNumber(f"wheel_radius/{name}", _tolerance(robot, "wheel_radius", caster.wheel_radius), own("wheel_radius")),
        HealthyNumber(f"steer_zero/{name}", _tolerance(robot, "steer_zero", 0.0), zero, described=False),
    ]
    for key in ("caster_offset", "steer_axis"):
        for index, letter in enumerate("xy"):
            found.append(HealthyNumber(f"{key}.{letter}/{name}", _tolerance(robot, key, 0.0), own(key, index)))
    for axis in AXIS_NAMES:
        deviation = _tolerance(robot, "torque_constant", 1.0)
        found.append(HealthyNumber(f"torque_constant/{name}_{axis}", deviation, gain(axis), described=False))
        spread = _tolerance(robot, "contact.stiffness_spread", 1.0)
        found.append(HealthyNumber(f"contact.stiffness/{name}_{axis}", spread, _compliance_of(name, axis), described=False))
    return found


def _imu_numbers(robot: RobotDescription) -> list[HealthyNumber]:
    def place(index: int) -> Change:
        def change(r: RobotDescription, value: float) -> RobotDescription:
            assert r.sensors.imu is not None
            moved = dataclasses.replace(r.sensors.imu, position=_entry(r.sensors.imu.position, index, value))
            return dataclasses.replace(r, sensors=dataclasses.replace(r.sensors, imu=moved))

        return change

    def error(effect: str, parameter: str) -> Change:
        return lambda r, value: _with_effect(r, effect, ("imu",), {"gyro": 0.0, parameter: value})

    scale = _tolerance(robot, "imu.scale", 1.0)
    found = [
        HealthyNumber("imu.gyro_bias", _tolerance(robot, "imu.gyro_bias", 0.0), error("imu_bias", "gyro"), described=False),
        HealthyNumber("imu.gyro_scale", scale, error("imu_scale", "gyro"), described=False),
    ]
    bias = _tolerance(robot, "imu.accelerometer_bias", 0.0)
    for index, letter in enumerate("xy"):
        key = f"accelerometer_{letter}"
        found += [
            HealthyNumber(f"imu.position.{letter}", _tolerance(robot, "imu.position", 0.0), place(index)),
            HealthyNumber(f"imu.accelerometer_bias.{letter}", bias, error("imu_bias", key), described=False),
            HealthyNumber(f"imu.accelerometer_scale.{letter}", scale, error("imu_scale", key), described=False),
        ]
    return found


def _with_effect(
    robot: RobotDescription, name: str, target: Sequence[str], parameters: Mapping[str, float], axis: str | None = None
) -> RobotDescription:
    return dataclasses.replace(robot, physics=(*robot.physics, effect_instance(name, target, parameters, axis)))


def _friction(robot: RobotDescription, value: float) -> RobotDescription:
    def change(tyre: ContactDescription) -> ContactDescription:
        lateral = dataclasses.replace(tyre.lateral, mu_p=tyre.lateral.mu_p * (1.0 + value))
        return dataclasses.replace(tyre, mu_p=tyre.mu_p * (1.0 + value), lateral=lateral)

    return robot.with_tyres(robot.caster_names, change)


def _compliance(robot: RobotDescription, value: float) -> RobotDescription:
    """The slip that a force takes, more by `value` of it."""
    return robot.with_tyres(robot.caster_names, lambda tyre: _softer(_softer(tyre, "drive", value), "steer", value))


def _compliance_of(caster: str, axis: str) -> Change:
    """The same of one tyre, along its heading ("drive") or across."""
    return lambda robot, value: robot.with_tyres([caster], lambda tyre: _softer(tyre, axis, value))


def _softer(tyre: ContactDescription, axis: str, value: float) -> ContactDescription:
    factor = max(1.0 + value, STIFFEST)
    if axis == "drive":
        return dataclasses.replace(tyre, lambda_p=min(tyre.lambda_p * factor, 1.0))
    lateral = dataclasses.replace(tyre.lateral, lambda_p=min(tyre.lateral.lambda_p * factor, 1.0))
    return dataclasses.replace(tyre, lateral=lateral)


def _relaxation(robot: RobotDescription, value: float) -> RobotDescription:
    def change(tyre: ContactDescription) -> ContactDescription:
        length = tyre.relaxation_length
        return dataclasses.replace(tyre, relaxation_length=max(length + value, STIFFEST * length))

    return robot.with_tyres(robot.caster_names, change)


def _clock(robot: RobotDescription, sensor: str, parameter: str) -> HealthyNumber:
    def late(r: RobotDescription, value: float) -> RobotDescription:
        return _with_effect(r, "clock_offset", ("clock",), {"offset": 0.0, parameter: value})

    return HealthyNumber(f"clock.offset.{sensor}", _tolerance(robot, "clock.offset", 0.0), late, described=False)

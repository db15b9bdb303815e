"""The robot as its `physics` say it really is: effects that are another number than the description's, applied."""

from __future__ import annotations

import dataclasses

from pcw_description.effects.kinds import DescriptionEffect, TransmissionEffect
from pcw_description.effects.registry import get
from pcw_description.errors import DescriptionError
from pcw_description.robot_description import AXIS_NAMES, Caster, RobotDescription

from .plant import PlantError


def as_it_really_is(robot: RobotDescription) -> RobotDescription:
    """Return the robot with every `DescriptionEffect` of its physics applied.

    Raises:
        PlantError: an effect makes it a robot that cannot be, such as a wheel without a radius.
    """
    changed = robot
    for index, instance in enumerate(robot.physics):
        effect = get(instance.name)
        if isinstance(effect, DescriptionEffect):
            try:
                changed = effect.apply(changed, instance.target, instance.parameters)
                if min(caster.wheel_radius for caster in changed.casters) <= 0.0:
                    raise PlantError(f"physics[{index}]: {instance.name} leaves a wheel without a radius")
            except DescriptionError as error:
                raise PlantError(f"physics[{index}]: {instance.name} makes a robot that cannot be: {error}") from None
    return changed


def without_geared_rotors(robot: RobotDescription) -> RobotDescription:
    """Return the robot without the rotors that turn on their own, behind a gear of its `physics`."""
    for instance in robot.physics:
        effect = get(instance.name)
        if isinstance(effect, TransmissionEffect):
            rotor = {(instance.axis or effect.axis): 0.0}
            if set(rotor) <= set(AXIS_NAMES):

                def taken_off(caster: Caster, rotor: dict[str, float] = rotor) -> Caster:
                    return dataclasses.replace(caster, rotors=dataclasses.replace(caster.rotors, **rotor))

                robot = robot.with_casters(instance.target, taken_off)
    return robot

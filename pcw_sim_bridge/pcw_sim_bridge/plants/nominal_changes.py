"""The robot as its `physics` say it really is: effects that are another number than the description's, applied."""

from __future__ import annotations

from pcw_description.effects.effect import DescriptionEffect, JointTorqueEffect
from pcw_description.effects.registry import get
from pcw_description.robot_description import RobotDescription

from .plant import PlantError


def as_it_really_is(robot: RobotDescription) -> RobotDescription:
    """Return the robot with every `DescriptionEffect` of its physics applied; the others are left to the plant.

    Raises:
        PlantError: an effect of a kind that the plants do not know.
    """
    changed = robot
    for instance in robot.physics:
        effect = get(instance.name)
        if isinstance(effect, DescriptionEffect):
            changed = effect.apply(changed, instance.target, instance.parameters)
        elif not isinstance(effect, JointTorqueEffect):
            raise PlantError(
                f"physics: the plants cannot produce {instance.name!r} ({type(effect).__name__}) yet"
            )
    return changed

"""A tyre that needs another rolled distance than described until its force has built up."""

import dataclasses
from collections.abc import Mapping, Sequence

from ..robot_description import RobotDescription
from .effect import EffectParameter
from .kinds import DescriptionEffect


def with_other_relaxation(robot: RobotDescription, target: Sequence[str], parameters: Mapping[str, float]) -> RobotDescription:
    """Return the robot whose targets have the relaxation length `length`."""
    return robot.with_tyres(target, lambda tyre: dataclasses.replace(tyre, relaxation_length=parameters["length"]))


EFFECT = DescriptionEffect(
    name="tyre_relaxation",
    target_kind="caster",
    axis="drive",
    summary="The tyre's force builds up over a rolled distance that is not the described one.",
    sentence="The tyre of {target} has a relaxation length of {length:.3g} m.",
    parameters=(
        EffectParameter(
            "length", "m", "rolled distance over which the force builds up", 1e-3, 1.0, 0.05,
            near_linear=True, neutral="contact.relaxation_length",
        ),
    ),
    sensors=("joint_states", "imu/data", "ground_truth/odom"),
    look_alikes=("tyre_longitudinal_stiffness", "tyre_lateral_stiffness", "actuator_lag"),
    separating_experiment="reverse the steering quickly at two speeds: the side force is late by a distance, not by a time",
    apply=with_other_relaxation,
)

"""A wheel that stands elsewhere behind its steering axis than described."""

import dataclasses
from collections.abc import Mapping, Sequence

from ..robot_description import RobotDescription, possible_caster
from .effect import EffectParameter
from .kinds import DescriptionEffect


def with_other_offset(robot: RobotDescription, target: Sequence[str], parameters: Mapping[str, float]) -> RobotDescription:
    """Return the robot with (x, y) added to the caster offset of each target."""
    return robot.with_casters(
        target,
        lambda caster: possible_caster(dataclasses.replace(
            caster, caster_offset=(caster.caster_offset[0] + parameters["x"], caster.caster_offset[1] + parameters["y"])
        )),
    )


EFFECT = DescriptionEffect(
    name="caster_offset_error",
    target_kind="caster",
    axis="steer",
    summary="The wheel centre is not where the description has it, seen from the steering axis.",
    sentence="The wheel of {target} is {x:+.3g} m ahead and {y:+.3g} m to the left of its described place.",
    parameters=(
        EffectParameter("x", "m", "along the rolling direction", -0.5, 0.5, 1e-3, near_linear=True),
        EffectParameter("y", "m", "across it, to the left", -0.5, 0.5, 1e-3, default=0.0, near_linear=True),
    ),
    sensors=("joint_states", "imu/data", "ground_truth/odom"),
    look_alikes=("wheel_radius_error", "steer_zero_offset", "tyre_lateral_stiffness"),
    separating_experiment="turn the steering through large angles at standstill and in slow curves both ways",
    apply=with_other_offset,
)

"""A wheel whose rolling radius is not the described one: wear, load, another tyre."""

import dataclasses
from collections.abc import Mapping, Sequence

from ..robot_description import RobotDescription, possible_caster
from .effect import EffectParameter
from .kinds import DescriptionEffect


def with_other_radius(robot: RobotDescription, target: Sequence[str], parameters: Mapping[str, float]) -> RobotDescription:
    """Return the robot with `error` added to the wheel radius of each target.

    Raises:
        DescriptionError: no radius is left.
    """
    return robot.with_casters(
        target,
        lambda caster: possible_caster(dataclasses.replace(caster, wheel_radius=caster.wheel_radius + parameters["error"])),
    )


EFFECT = DescriptionEffect(
    name="wheel_radius_error",
    target_kind="caster",
    axis="drive",
    summary="The rolling radius of the wheel is not the described one.",
    sentence="The rolling radius of {target} is {error:+.3g} m off.",
    parameters=(EffectParameter("error", "m", "true minus described radius", -0.5, 0.5, 5e-4, near_linear=True),),
    sensors=("joint_states", "imu/data", "ground_truth/odom"),
    look_alikes=("caster_offset_error", "imu_scale", "tyre_longitudinal_stiffness"),
    separating_experiment="drive straight over a measured distance",
    apply=with_other_radius,
)

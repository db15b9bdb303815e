"""A contact patch wider than described: the torque that resists turning the wheel on the spot."""

import dataclasses
from collections.abc import Mapping, Sequence

from ..robot_description import RobotDescription
from .effect import EffectParameter
from .kinds import DescriptionEffect


def with_wider_patch(robot: RobotDescription, target: Sequence[str], parameters: Mapping[str, float]) -> RobotDescription:
    """Return the robot with `radius` added to the scrub radius of each target."""
    return robot.with_tyres(
        target, lambda tyre: dataclasses.replace(tyre, scrub_radius=tyre.scrub_radius + parameters["radius"])
    )


EFFECT = DescriptionEffect(
    name="scrub_torque",
    target_kind="caster",
    axis="steer",
    summary="The contact patch resists turning about the vertical, most of all on the spot.",
    sentence="A contact patch with {radius:.3g} m more scrub radius under {target}.",
    parameters=(
        EffectParameter("radius", "m", "what the effective radius of the patch is more", 0.0, 0.1, 5e-3, squared=True),
    ),
    sensors=("joint_states",),
    look_alikes=("steer_coulomb_friction", "steer_viscous_friction"),
    separating_experiment="steer at standstill and while rolling fast: scrub fades with speed, friction does not",
    apply=with_wider_patch,
)
